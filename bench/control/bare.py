"""Serves as the anchor: gRPC for Python with its own mutual TLS answers as the control plane would, without its logic.

`python -m bench.control.bare PORT TLS_DIR SIZE SERVICE INTERFACE SERVER...` welcomes every member that registers, with
the intervals of a fleet of SIZE, and maps each robot to the servers. After SIGUSR2 it answers a robot's next message
with a mapping without the first of them. There is no gate, no registry, no estimate, no solver: what is left is the
cost that any control plane in this language has for as many streams.
"""

from __future__ import annotations

import asyncio
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import grpc

from plr.controlplane.core.overload.pacing import Pacing
from plr.protos.convert import control_message_to_proto, parse_sidecar_message
from plr.protos.model.ids import InterfaceName, NodeName, Role, ServiceName, Version
from plr.protos.model.mapping import Assignment, MappingSet, ServiceMapping
from plr.protos.model.members import PeerSet, Registration
from plr.protos.model.stream import Welcome
from plr.protos.plr.v1 import control_pb2

if TYPE_CHECKING:
    Context = grpc.aio.ServicerContext[bytes, bytes]

SERVICE = control_pb2.DESCRIPTOR.services_by_name["ControlPlane"].full_name
LEASE_S, INTERVAL_S = 5.0, 0.5
"""The control plane's defaults."""


class Bare:
    """Serves `Connect`; robots use `service` over `interface`."""

    def __init__(self, size: int, servers: list[NodeName], service: ServiceName, interface: InterfaceName) -> None:
        pacing = Pacing(interval_s=INTERVAL_S, lease_s=LEASE_S)
        pacing.follow(size, 0.0)
        welcome = Welcome(pacing.lease_s, pacing.interval_s, (), b"", pacing.reconnect_max_s)
        self._welcome = control_message_to_proto(welcome).SerializeToString()
        self._peers = control_message_to_proto(PeerSet(Version(1), 1, ())).SerializeToString()
        self._mappings = []
        for version, left in enumerate((servers, servers[1:]), start=1):
            assignments = tuple(Assignment(interface, server) for server in left)
            mapping = MappingSet(Version(version), version, (ServiceMapping(service, assignments),))
            self._mappings.append(control_message_to_proto(mapping).SerializeToString())
        self.lost = False

    async def connect(self, _: object, context: Context) -> None:
        """Serve one stream."""
        first = parse_sidecar_message(await context.read())
        is_robot = isinstance(first, Registration) and first.role is Role.ROBOT
        await context.write(self._welcome)
        await context.write(self._peers)
        if is_robot:
            await context.write(self._mappings[0])
        told = not is_robot
        while isinstance(data := await context.read(), bytes):
            parse_sidecar_message(data)
            if self.lost and not told:
                told = True
                await context.write(self._mappings[1])

    def lose_first(self) -> None:
        """Treat the first server as dead."""
        self.lost = True


async def serve(port: int, tls: Path, bare: Bare) -> None:
    """Serve forever."""
    asyncio.get_running_loop().add_signal_handler(signal.SIGUSR2, bare.lose_first)
    ca, cert, key = ((tls / name).read_bytes() for name in ("ca.pem", "cert.pem", "key.pem"))
    server = grpc.aio.server(options=(("grpc.so_reuseport", 0),))
    handler: grpc.RpcMethodHandler[bytes, bytes] = grpc.stream_stream_rpc_method_handler(bare.connect)
    server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(SERVICE, {"Connect": handler}),))
    server.add_secure_port(
        f"127.0.0.1:{port}", grpc.ssl_server_credentials([(key, cert)], ca, require_client_auth=True)
    )
    await server.start()
    await server.wait_for_termination()


def main(arguments: list[str]) -> None:
    """Run the command line."""
    port, tls, size, service, interface, *servers = arguments
    bare = Bare(int(size), [NodeName(server) for server in servers], ServiceName(service), InterfaceName(interface))
    asyncio.run(serve(int(port), Path(tls), bare))


if __name__ == "__main__":
    main(sys.argv[1:])
