"""Implements the sidecar's end of the control stream, and chooses the way to the control plane. Imports `base`."""
