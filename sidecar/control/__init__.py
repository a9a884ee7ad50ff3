"""Drives `plr.sidecar.core.control` with a control stream over gRPC."""
