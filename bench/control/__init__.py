"""Loads the control plane with a fleet: the real program, real mutual TLS, hundreds to thousands of streams."""
