"""Implements `--version` for all programs."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING, Any

from plr.protos.model.ids import PROTOCOL_VERSION
from plr.protos.program import commit

if TYPE_CHECKING:
    from collections.abc import Sequence


def describe(program: str) -> str:
    """Return one line: the program, its version, the commit if known, and the protocol's version."""
    return f"{program} {commit.version()} (protocol {PROTOCOL_VERSION})"


class ShowVersion(argparse.Action):
    """Prints the version and ends the program; only then is the version determined."""

    def __init__(self, option_strings: Sequence[str], dest: str) -> None:
        text = "show the version, the commit and the protocol, then exit"
        super().__init__(option_strings, argparse.SUPPRESS, nargs=0, default=argparse.SUPPRESS, help=text)

    def __call__(self, parser: argparse.ArgumentParser, *_: Any, **__: Any) -> None:
        """Print the version and end the program."""
        sys.stdout.write(f"{describe(parser.prog)}\n")
        parser.exit()
