"""The site of the pages, `make docs`: what mkdocs.yml at the top does not say."""
