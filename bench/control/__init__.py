"""The control plane under the load of a fleet: the real program, real mutual TLS, hundreds to thousands of streams."""
