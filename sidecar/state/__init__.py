"""What the sidecar keeps on disk and what it draws at each start."""
