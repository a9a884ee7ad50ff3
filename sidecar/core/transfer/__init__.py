"""Messages that are not delivered yet, across all paths. Imports `base`, `wire`, `message` and `seam`."""
