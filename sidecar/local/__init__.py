"""Serves the local socket on which a node tells of itself."""
