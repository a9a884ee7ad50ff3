"""`plr config`: shows which keys a program's configuration has."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import TYPE_CHECKING

from plr.controlplane.config.controlplane import ControlPlaneConfig
from plr.protos.program.exit_codes import EXIT_OK

if TYPE_CHECKING:
    import argparse

    from plr.protos.program.arguments import Commands


def add_to(commands: Commands, summary: str) -> None:
    """Add the command to `plr`."""
    config = commands.add_parser("config", help=summary)
    about = config.add_subparsers(required=True, metavar="COMMAND")
    schema = about.add_parser("schema", help="print the JSON Schema of a program's configuration")
    schema.add_argument("program", choices=["controlplane", "sidecar"])
    schema.set_defaults(run=_schema)


def _schema(arguments: argparse.Namespace) -> int:
    if arguments.program == "sidecar":
        # The planes do not import each other: ask the program that has these keys.
        return subprocess.run([sys.executable, "-m", "plr.sidecar", "--print-schema"], check=False).returncode
    sys.stdout.write(json.dumps(ControlPlaneConfig.model_json_schema(), indent=2) + "\n")
    return EXIT_OK
