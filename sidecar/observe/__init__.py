"""Shows how the sidecar is doing: metrics and unmet services."""
