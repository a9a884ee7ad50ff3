"""Reads the sidecar's configuration file."""
