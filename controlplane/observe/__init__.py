"""Metrics and the event log of the control plane."""
