"""Command lines of what `plr` does on a node."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from sidecar.doctor.examination import DEFAULT_CONFIG, Where

if TYPE_CHECKING:
    from collections.abc import Callable

EXIT_USAGE = 2


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        self.exit(EXIT_USAGE, f"{self.prog}: {message}; see {self.prog} --help\n")


def parser_of(program: str, about: str | None) -> argparse.ArgumentParser:
    """Return a parser that knows which sidecar is meant; `about` is a module's docstring."""
    summary, _, epilog = (about or "").partition("\n\n")
    parser = _Parser(
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
    """Return which sidecar the options mean."""
    return Where(options.config, options.socket)


def number(least: float, most: float) -> Callable[[str], float]:
    """Return what reads a number from `least` to `most`."""

    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not least <= value <= most:
            raise argparse.ArgumentTypeError(f"expected a number from {least:g} to {most:g}, got {text!r}")
        return value

    return read


def whole(least: int, most: int) -> Callable[[str], int]:
    """Return what reads a whole number from `least` to `most`."""

    def read(text: str) -> int:
        if not (text.isascii() and text.isdigit() and least <= int(text) <= most):
            raise argparse.ArgumentTypeError(f"expected a whole number from {least} to {most}, got {text!r}")
        return int(text)

    return read
