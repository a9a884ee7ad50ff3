#!/usr/bin/env bash
# Builds the site of the pages into build/site: open build/site/index.html, also without a network. What builds it is
# installed here, not by `make setup`, which nothing else would need.
set -euo pipefail
cd "$(dirname "$0")/../.."

.venv/bin/uv pip install --quiet --python .venv/bin/python --no-build-isolation --require-hashes -r requirements/docs.txt
.venv/bin/python -m deploy.dev.site build/docs
# Not --quiet: it would also hide from --strict what is wrong. The maker advertises the successor in every build.
NO_MKDOCS_2_WARNING=1 .venv/bin/python -m mkdocs build --strict
echo "docs: build/site/index.html"
