"""plr: ask a running control plane, certify the fleet's nodes, try out a policy, look up configuration keys.

examples:
  plr status --tls-dir ~/.plr/alice --address control.example.org:50051
  plr status --insecure --json
  plr ca init
  plr ca issue robot-1 --role robot
  plr config schema controlplane
  plr config schema sidecar
  plr policy check --config /etc/plr/controlplane.yaml --robot arm-1 --service /plan --cloud cloud-a

exit codes: 0 ok, 1 the control plane cannot be reached or is not in order, or the policy denies it, 2 bad usage
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import grpc
from google.protobuf import json_format

from controlplane import policy_command, status_table, version
from controlplane.ca import commands as ca_commands
from controlplane.config import ControlPlaneConfig
from protos import tls_advice
from protos.config_fields import check_remote
from protos.convert import status_from_proto
from protos.errors import ConfigError, DecodeError
from protos.identity import CONTROL_PLANE_DNS
from protos.plr.v1 import admin_pb2, admin_pb2_grpc
from protos.tls_files import load_tls_files

if TYPE_CHECKING:
    from collections.abc import Sequence

    from protos.tls_files import TlsFiles

EXIT_OK = 0
EXIT_FAILED = 1
EXIT_USAGE = 2

_OPTIONS = (
    # A thousand robots with their paths and histograms are more than gRPC's default of 4 MiB.
    ("grpc.max_receive_message_length", 256 << 20),
    # Behaviour comes from the command line, not from the environment.
    ("grpc.enable_http_proxy", 0),
    # Whatever its address: the name in the certificate of every control plane of the fleet.
    ("grpc.ssl_target_name_override", CONTROL_PLANE_DNS),
)

DEFAULT_ADDRESS = "127.0.0.1:50051"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program; returns its exit code."""
    arguments = _parser().parse_args(argv)
    code: int = arguments.run(arguments)
    return code


def _parser() -> argparse.ArgumentParser:
    summary, _, epilog = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        prog="plr",
        description=summary,
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=version.describe("plr"))
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    status = commands.add_parser("status", help="who is connected, and how far each follows")
    status.add_argument("--address", type=_address, default=DEFAULT_ADDRESS, metavar="HOST:PORT")
    security = status.add_mutually_exclusive_group(required=True)
    security.add_argument(
        "--tls-dir", type=Path, metavar="DIR", help="folder with an operator's certificate, as plr ca issue writes it"
    )
    security.add_argument("--insecure", action="store_true", help="without TLS, for a control plane that has none")
    status.add_argument("--timeout-s", type=float, default=5.0, metavar="SECONDS")
    status.add_argument("--json", action="store_true", help="print the answer as JSON")
    status.set_defaults(run=_status)

    ca_commands.add_to(commands)

    config = commands.add_parser("config", help="about configuration files")
    about = config.add_subparsers(required=True, metavar="COMMAND")
    schema = about.add_parser("schema", help="print the JSON Schema of a program's configuration")
    schema.add_argument("program", choices=["controlplane", "sidecar"])
    schema.set_defaults(run=_schema)

    policy_command.add_to(commands)
    return parser


def _address(text: str) -> str:
    try:
        return check_remote(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def _status(arguments: argparse.Namespace) -> int:
    files = None
    try:
        files = load_tls_files(arguments.tls_dir) if arguments.tls_dir is not None else None
        with _open_channel(arguments.address, files) as channel:
            stub = admin_pb2_grpc.AdminStub(channel)
            answer = stub.GetStatus(admin_pb2.GetStatusRequest(), timeout=arguments.timeout_s)
        sidecars = status_from_proto(answer)
    except grpc.RpcError as error:
        # The error of a call is the call itself, which the stubs do not say.
        detail = " ".join(str(getattr(error, "details", error.__str__)()).split())
        unavailable = getattr(error, "code", lambda: None)() is grpc.StatusCode.UNAVAILABLE
        advice = tls_advice.explain(detail, files, time.time()) if unavailable else None
        sys.stderr.write(f"plr: {arguments.address}: {advice or detail}\n")
        return EXIT_FAILED
    except ConfigError as error:
        sys.stderr.write(f"plr: {error}\n")
        return EXIT_USAGE
    except DecodeError as error:
        sys.stderr.write(f"plr: {arguments.address}: answers what it must not: {error}\n")
        return EXIT_FAILED
    if arguments.json:
        print(json_format.MessageToJson(answer, preserving_proto_field_name=True))
    else:
        print(status_table.render(sidecars))
    return EXIT_OK


def _open_channel(address: str, files: TlsFiles | None) -> grpc.Channel:
    if files is None:
        return grpc.insecure_channel(address, _OPTIONS)
    credentials = grpc.ssl_channel_credentials(files.ca_pem, files.key_pem, files.certificate_pem)
    return grpc.secure_channel(address, credentials, _OPTIONS)


def _schema(arguments: argparse.Namespace) -> int:
    if arguments.program == "sidecar":
        # The planes do not import each other: the program that has these keys is asked.
        return subprocess.run([sys.executable, "-m", "sidecar", "--print-schema"], check=False).returncode
    print(json.dumps(ControlPlaneConfig.model_json_schema(), indent=2))
    return EXIT_OK


if __name__ == "__main__":
    sys.exit(main())
