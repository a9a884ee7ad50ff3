"""Keeps undelivered messages, across all paths. Imports `base`, `wire`, `message`, `seam` and `rules`."""
