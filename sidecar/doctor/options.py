"""Parses the options common to the commands that `plr` runs on a node."""

from __future__ import annotations

import argparse
from pathlib import Path

from plr.protos.program.arguments import OneLineParser
from plr.sidecar.doctor.examination import DEFAULT_CONFIG, Where


def parser_of(program: str, about: str | None) -> argparse.ArgumentParser:
    """Return a parser with the options that select a sidecar; `about` is a module's docstring."""
    summary, _, epilog = (about or "").partition("\n\n")
    parser = OneLineParser(
        prog=program,
        description=summary.partition(": ")[2],
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument(
        "--config", type=Path, default=DEFAULT_CONFIG, metavar="FILE", help="the sidecar's (default: %(default)s)"
    )
    parser.add_argument("--socket", type=Path, metavar="PATH", help="its local socket (default: as configured)")
    return parser


def where_of(options: argparse.Namespace) -> Where:
    """Return which sidecar the options select."""
    return Where(options.config, options.socket)
