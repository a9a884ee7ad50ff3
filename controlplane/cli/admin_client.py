"""Asks a running control plane for `plr`: the options, the connection, and errors in one line."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import grpc

from plr.protos.base.errors import ConfigError, DecodeError
from plr.protos.base.host_port import check_remote
from plr.protos.base.printable import escaped
from plr.protos.plr.v1 import admin_pb2_grpc
from plr.protos.program import tls_advice
from plr.protos.program.arguments import number
from plr.protos.program.exit_codes import EXIT_FAILED, EXIT_USAGE
from plr.protos.program.tls_files import load_tls_files
from plr.protos.trust.identity import CONTROL_PLANE_DNS

if TYPE_CHECKING:
    from collections.abc import Callable

    from plr.protos.program.tls_files import TlsFiles

A = TypeVar("A")

DEFAULT_ADDRESS = "127.0.0.1:50051"

MIN_TIMEOUT_S, MAX_TIMEOUT_S = 0.001, 3600.0


_OPTIONS = (
    # A thousand robots with their paths and histograms exceed gRPC's default of 4 MiB.
    ("grpc.max_receive_message_length", 256 << 20),
    # Behaviour comes from the command line, not from the environment.
    ("grpc.enable_http_proxy", 0),
    # The name in the certificate of every control plane of the fleet, whatever its address.
    ("grpc.ssl_target_name_override", CONTROL_PLANE_DNS),
)


_NO_IDENTITY = (
    "expected --tls-dir DIR, the folder with your operator's certificate (have one issued: plr ca issue NAME --role "
    "operator), or --insecure for a control plane without TLS"
)


class AskError(Exception):
    """There is no answer; the text is one line for a terminal, and `code` its exit code."""

    def __init__(self, text: str, code: int) -> None:
        super().__init__(escaped(text))
        self.code = code


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that choose the control plane, the identity of the asker, and how the answer is printed."""
    parser.add_argument("--address", type=_address, default=DEFAULT_ADDRESS, metavar="HOST:PORT")
    security = parser.add_mutually_exclusive_group()
    security.add_argument(
        "--tls-dir", type=Path, metavar="DIR", help="folder with an operator's certificate, as plr ca issue writes it"
    )
    security.add_argument("--insecure", action="store_true", help="connect without TLS, if the control plane has none")
    parser.add_argument("--timeout-s", type=number(MIN_TIMEOUT_S, MAX_TIMEOUT_S), default=5.0, metavar="SECONDS")
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")


def _address(text: str) -> str:
    try:
        return check_remote(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def ask(arguments: argparse.Namespace, call: Callable[[admin_pb2_grpc.AdminStub, float], A]) -> A:
    """Run `call` with the stub and the time limit in seconds, and return its result.

    Raises:
        AskError: no answer, or not one that could be converted (`call` raised DecodeError).
    """
    files = None
    address = arguments.address
    if arguments.tls_dir is None and not arguments.insecure:
        raise AskError(_NO_IDENTITY, EXIT_USAGE)
    try:
        files = load_tls_files(arguments.tls_dir) if arguments.tls_dir is not None else None
        with _open_channel(address, files) as channel:
            return call(admin_pb2_grpc.AdminStub(channel), arguments.timeout_s)
    except grpc.RpcError as error:
        # The error of a call is the call itself, which the type stubs do not declare.
        detail = " ".join(str(getattr(error, "details", error.__str__)()).split())
        code = getattr(error, "code", lambda: None)()
        if code is grpc.StatusCode.NOT_FOUND:
            raise AskError(detail, EXIT_FAILED) from error
        if code is grpc.StatusCode.DEADLINE_EXCEEDED:
            raise AskError(f"{address}: {_late(arguments.timeout_s)}", EXIT_FAILED) from error
        advice = _advice(detail, files) if code is grpc.StatusCode.UNAVAILABLE else None
        raise AskError(f"{address}: {advice or detail}", EXIT_FAILED) from error
    except ConfigError as error:
        raise AskError(str(error), EXIT_USAGE) from error
    except DecodeError as error:
        raise AskError(f"{address}: the answer is malformed: {error}", EXIT_FAILED) from error


def _late(timeout_s: float) -> str:
    return (
        f"no answer within {timeout_s:g} s: check that the control plane's host is up and that firewalls let TCP "
        "through, or allow more time with --timeout-s"
    )


def _advice(detail: str, files: TlsFiles | None) -> str | None:
    """Return what gRPC's text for a failed connection means, and what to do; None if there is nothing to add."""
    if "Connection refused" in detail:
        return (
            "nothing listens on this TCP port: check that the control plane runs, and give the address in its listen "
            "key (port 50051 by default), not that of STUN"
        )
    return tls_advice.explain(detail, files, time.time())


def _open_channel(address: str, files: TlsFiles | None) -> grpc.Channel:
    if files is None:
        return grpc.insecure_channel(address, _OPTIONS)
    credentials = grpc.ssl_channel_credentials(files.ca_pem, files.key_pem, files.certificate_pem)
    return grpc.secure_channel(address, credentials, _OPTIONS)
