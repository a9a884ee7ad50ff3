"""What the control plane shows and remembers: metrics, and the log of events."""
