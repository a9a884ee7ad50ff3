"""Stands in for the control plane with an unfit certificate: `python -m lab.attacker.stand_in PORT TLS_DIR`.

It prints a line for every call that is actually made.
"""

from __future__ import annotations

import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import grpc


class _Anything(grpc.GenericRpcHandler):
    """Accepts every call and never answers."""

    def service(self, handler_call_details: grpc.HandlerCallDetails) -> Any:
        """Serve any method."""
        print(f"called: {handler_call_details.method}", flush=True)
        return grpc.stream_stream_rpc_method_handler(lambda requests, _: requests)


def main() -> int:
    """Run the command line."""
    port, tls_dir = sys.argv[1], Path(sys.argv[2])
    key, certificate = ((tls_dir / name).read_bytes() for name in ("key.pem", "cert.pem"))
    server = grpc.server(ThreadPoolExecutor(4), handlers=[_Anything()])
    server.add_secure_port(f"0.0.0.0:{port}", grpc.ssl_server_credentials([(key, certificate)]))
    server.start()
    print("listens", flush=True)
    server.wait_for_termination()
    return 0


if __name__ == "__main__":
    sys.exit(main())
