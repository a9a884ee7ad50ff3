"""The control stream over gRPC: what drives `sidecar.core.control`."""
