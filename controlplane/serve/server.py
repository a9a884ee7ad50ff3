"""Runs the whole control plane in one event loop: gRPC, STUN, metrics, and an orderly end."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import socket
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import grpc
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection

from plr.controlplane.loop import ControlLoop
from plr.controlplane.observe.event_log import EventLog
from plr.controlplane.observe.metrics import Metrics
from plr.controlplane.serve import admin, service
from plr.controlplane.serve.access import AccessGuard
from plr.controlplane.serve.certificate_watch import CertificateKeeper
from plr.controlplane.serve.socket_folder import socket_folder, socket_path
from plr.controlplane.serve.stream_limits import MAX_STREAM_MESSAGE_BYTES, MAX_STREAMS_PER_CONNECTION
from plr.controlplane.serve.stun_server import start_stun_server
from plr.controlplane.serve.tls_gate import TlsGate
from plr.protos.base.host_port import split_host_port
from plr.protos.model.fleet_events import EventKind
from plr.protos.model.members import MAX_SIDECARS
from plr.protos.program.version_option import describe
from plr.protos.trust.clock_floor import ClockFloor

if TYPE_CHECKING:
    from collections.abc import Callable

    from plr.controlplane.config.controlplane import ControlPlaneConfig
    from plr.controlplane.config.policy_reload import PolicyReload
    from plr.protos.program.tls_files import TlsFiles

log = logging.getLogger(__name__)

STOP_GRACE_S = 1.0
"""Time for streams to take their last message; those that still hang are cut."""

STATUS_EVERY_S = 2.0
"""Interval between updates of the state that `systemctl status` shows."""

GRPC_OPTIONS: tuple[tuple[str, int], ...] = (
    # Sidecars behind cellular NATs ping to keep their binding, even with no call open, but not faster than this.
    ("grpc.keepalive_permit_without_calls", 1),
    ("grpc.http2.min_ping_interval_without_data_ms", 5_000),
    # Our pings find connections that died silently; the lease has removed their sidecar by then.
    ("grpc.keepalive_time_ms", 20_000),
    ("grpc.keepalive_timeout_ms", 10_000),
    ("grpc.max_receive_message_length", MAX_STREAM_MESSAGE_BYTES),
    ("grpc.max_concurrent_streams", MAX_STREAMS_PER_CONNECTION),
    # A connection without a call keeps its place for as long as somebody reads the answer to the previous call.
    ("grpc.max_connection_idle_ms", 60_000),
    # A second control plane on the same port is an error to report, not one to share the streams with.
    ("grpc.so_reuseport", 0),
)

SERVERS = 8
"""gRPC servers behind the gate, which hands connections to them in rotation. One server takes one new call every two
turns of the event loop: few a second when a fleet comes back and turns are long. gRPC has no option for it."""

MAX_CALLS = 2 * MAX_SIDECARS
"""Concurrent calls: a stream for each sidecar, with room for replacement streams and the operator."""


_SERVICES = ("", service.SERVICE_NAME, admin.SERVICE_NAME)
"""Names that the health service answers for; the first is the server as a whole."""


class ListenError(Exception):
    """An address is not available; the text names the configuration key."""


@dataclass(frozen=True, slots=True)
class Addresses:
    """The addresses that the control plane listens on, with the ports actually taken."""

    grpc: str
    stun: tuple[str, ...]
    metrics: str | None


async def serve(
    config: ControlPlaneConfig,
    files: TlsFiles | None,
    reload: PolicyReload,
    stop: asyncio.Event,
    ready: Callable[[Addresses], None],
    stopping: Callable[[], None],
    tell: Callable[[str], None],
) -> None:
    """Serve until `stop`; calls `ready` when everything listens, `stopping` when the end begins.

    `tell` receives the state in a few words, now and then.

    `files` is None in insecure mode. Raises StartError if an address is not available.
    """
    metrics = Metrics()
    events = EventLog(config.state_dir)
    async with contextlib.AsyncExitStack() as cleanup:
        cleanup.callback(events.close)
        loop = ControlLoop(config, metrics, events)
        # Nobody but this user can reach the socket behind the gate.
        folder = cleanup.enter_context(socket_folder())
        upstreams = [socket_path(folder, number) for number in range(SERVERS)]
        clock = ClockFloor(time.time, alert=log.error)
        gate = TlsGate(files, upstreams, metrics.refused_connection, clock) if files is not None else None
        if gate is not None:
            loop.has_unread = gate.has_unread
            gate.on_member_refused = loop.refused_member
        servers, health_service = _make_servers(config, loop, metrics, gate)
        stun = await _start_stun(config, loop, cleanup)
        loop.update_metrics()
        metrics.watch_fleet(loop.ask_fleet)
        metrics_address = _start_metrics(config, metrics)
        if gate is None:
            grpc_address = _add_port(config, servers[0])
        else:
            for server, upstream in zip(servers, upstreams, strict=True):
                server.add_insecure_port(f"unix:{upstream}")
            grpc_address = _open_gate(config, gate)
            cleanup.push_async_callback(gate.close)
        for server in servers:
            await server.start()
            cleanup.push_async_callback(server.stop, 0.0)
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(loop.run())
            keeper = None
            if files is not None and gate is not None:
                keeper = tasks.create_task(CertificateKeeper(files, gate, loop, metrics, clock).run())
            telling = tasks.create_task(_tell_status(loop, tell))
            reloading = tasks.create_task(reload.run(loop.set_policy, metrics))
            for name in _SERVICES:
                await health_service.set(name, health_pb2.HealthCheckResponse.SERVING)
            ready(Addresses(grpc_address, stun, metrics_address))
            events.announce()
            events.record(EventKind.STARTED, text=describe("plr-controlplane"))
            await stop.wait()
            stopping()
            events.record(EventKind.STOPPED)
            await health_service.enter_graceful_shutdown()
            loop.close_streams()
            await asyncio.gather(*(server.stop(STOP_GRACE_S) for server in servers))
            loop.stop()
            reloading.cancel()
            telling.cancel()
            if keeper is not None:
                keeper.cancel()


async def _tell_status(loop: ControlLoop, tell: Callable[[str], None]) -> None:
    while True:
        tell(loop.status_line())
        await asyncio.sleep(STATUS_EVERY_S)


def _make_servers(
    config: ControlPlaneConfig, loop: ControlLoop, metrics: Metrics, gate: TlsGate | None
) -> tuple[list[grpc.aio.Server], health.aio.HealthServicer]:
    """Return identical servers; without a gate only one, since only the gate can divide connections."""
    guards = () if gate is None else (AccessGuard(gate.caller, metrics.refused_connection),)
    control_plane = service.ControlPlaneService(loop, config.report_interval_ms / 1000, gate)
    admin_service = admin.AdminService(loop)
    health_service = health.aio.HealthServicer()
    reflected = (service.SERVICE_NAME, admin.SERVICE_NAME, health.SERVICE_NAME, reflection.SERVICE_NAME)
    servers = []
    for _ in range(1 if gate is None else SERVERS):
        server = grpc.aio.server(interceptors=guards, options=GRPC_OPTIONS, maximum_concurrent_rpcs=MAX_CALLS)
        control_plane.add_to(server)
        admin_service.add_to(server)
        health_pb2_grpc.add_HealthServicer_to_server(health_service, server)
        reflection.enable_server_reflection(reflected, server)
        servers.append(server)
    return servers, health_service


def _open_gate(config: ControlPlaneConfig, gate: TlsGate) -> str:
    host, port = split_host_port(config.listen)
    try:
        return _join(host, gate.listen(host, port))
    except OSError as error:
        raise ListenError(f"listen: cannot listen on {config.listen}: {_reason(error)}") from error


async def _start_stun(
    config: ControlPlaneConfig, loop: ControlLoop, cleanup: contextlib.AsyncExitStack
) -> tuple[str, ...]:
    addresses: list[str] = []
    for listen in config.stun_listen:
        host, port = split_host_port(listen)
        try:
            # "" means all addresses of both families, of which IPv6 may be missing.
            stun = await start_stun_server("" if host == "::" else host, port)
        except OSError as error:
            raise ListenError(f"stun_listen: cannot listen on {listen}: {error.strerror or error}") from error
        cleanup.callback(stun.close)
        loop.stun_servers.append(stun)
        addresses.extend(_join(*address) for address in stun.addresses)
    return tuple(addresses)


def _start_metrics(config: ControlPlaneConfig, metrics: Metrics) -> str | None:
    if config.metrics_listen is None:
        return None
    host, port = split_host_port(config.metrics_listen)
    return _join(*metrics.start(host, port))


def _add_port(config: ControlPlaneConfig, server: grpc.aio.Server) -> str:
    host, wanted = split_host_port(config.listen)
    try:
        # gRPC writes a raw line of its own about an address that is not available, and does not tell us why.
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        socket.create_server((host, wanted), family=family).close()
        port = server.add_insecure_port(config.listen)
    except (OSError, RuntimeError) as error:
        raise ListenError(f"listen: cannot listen on {config.listen}: {_reason(error)}") from error
    return _join(host, port)


def _reason(error: OSError | RuntimeError) -> str:
    # The messages of asyncio and of `create_server` repeat the address.
    return os.strerror(error.errno) if isinstance(error, OSError) and error.errno else str(error)


def _join(host: str, port: int) -> str:
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
