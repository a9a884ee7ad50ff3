"""What the sidecar shows: metrics and unmet services."""
