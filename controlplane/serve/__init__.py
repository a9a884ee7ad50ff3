"""What sidecars and operators reach: the gate, the gRPC services, what is written to streams."""
