"""Keeps the sidecar's state on disk, and draws the session of each start."""
