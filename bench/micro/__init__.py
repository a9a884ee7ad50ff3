"""Counts the Python that one request executes: calls, functions, files. No figure depends on the machine."""
