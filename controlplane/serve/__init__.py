"""The parts that sidecars and operators reach: the gate, the gRPC services, the encoding of streams."""
