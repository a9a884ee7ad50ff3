"""Provides keys and sealing: AEAD, key schedule, the sidecar's own session. Imports nothing of the core."""
