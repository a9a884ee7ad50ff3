"""Opens the gRPC channel of a control stream: its options, its credentials, and what its status codes mean."""

from __future__ import annotations

from typing import TYPE_CHECKING

import grpc

from plr.protos.trust.identity import CONTROL_PLANE_DNS

if TYPE_CHECKING:
    from plr.protos.program.tls_files import TlsFiles

KEEPALIVE_TIME_MS = 10_000
"""Interval of pings: they detect a control plane that hangs while its kernel acknowledges, and keep NAT bindings for
TCP open. The dialer notices a dead path sooner."""

KEEPALIVE_TIMEOUT_MS = 5_000
"""A ping unanswered for this long ends the connection."""

_CHANNEL_OPTIONS: tuple[tuple[str, int | str], ...] = (
    ("grpc.keepalive_time_ms", KEEPALIVE_TIME_MS),
    ("grpc.keepalive_timeout_ms", KEEPALIVE_TIMEOUT_MS),
    ("grpc.http2.max_pings_without_data", 0),
    # The session decides when to try again: no retries and no remembered backoff below it.
    # A connection may take this long: when a large fleet comes back, the handshake waits for its turn. gRPC's default
    # of 20 s is shorter than `ControlSession` waits, and it is the session that should give up.
    ("grpc.min_reconnect_backoff_ms", 60_000),
    ("grpc.enable_retries", 0),
    ("grpc.use_local_subchannel_pool", 1),
    # Behaviour comes from the configuration, not from the environment.
    ("grpc.enable_http_proxy", 0),
    # The name in the certificate of every control plane of the fleet, whatever its address.
    ("grpc.ssl_target_name_override", CONTROL_PLANE_DNS),
)

REFUSALS = frozenset(
    {
        grpc.StatusCode.INVALID_ARGUMENT,
        grpc.StatusCode.FAILED_PRECONDITION,
        grpc.StatusCode.ABORTED,
        grpc.StatusCode.ALREADY_EXISTS,
        grpc.StatusCode.PERMISSION_DENIED,
        grpc.StatusCode.UNAUTHENTICATED,
        grpc.StatusCode.UNIMPLEMENTED,
        grpc.StatusCode.RESOURCE_EXHAUSTED,
    }
)
"""Status codes of a decision by the control plane, which it would repeat a moment later."""


def open_channel(target: str, files: TlsFiles | None) -> grpc.aio.Channel:
    """Return a channel to gRPC's `target`; without `files` (insecure mode) it is not encrypted."""
    if files is None:
        return grpc.aio.insecure_channel(target, options=_CHANNEL_OPTIONS)
    credentials = grpc.ssl_channel_credentials(files.ca_pem, files.key_pem, files.certificate_pem)
    return grpc.aio.secure_channel(target, credentials, options=_CHANNEL_OPTIONS)
