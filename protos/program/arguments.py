"""Reads the command lines of all programs: a mistake gets one line, safe for a terminal, and exit code 2."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, NoReturn, TypeVar

from plr.protos.base.errors import DecodeError
from plr.protos.base.printable import escaped
from plr.protos.program.exit_codes import EXIT_USAGE

if TYPE_CHECKING:
    from collections.abc import Callable

    Commands = argparse._SubParsersAction["OneLineParser"]

N = TypeVar("N")


class OneLineParser(argparse.ArgumentParser):
    """A parser that reports a mistake in one line; so do the parsers of its commands."""

    def error(self, message: str) -> NoReturn:
        """Say what is wrong, and end the program."""
        # A glob may expand to other users' files, and argparse repeats unknown arguments verbatim.
        self.exit(EXIT_USAGE, escaped(f"{self.prog}: {message}; see {self.prog} --help") + "\n")


def checked(check: Callable[[str, str], N], what: str = "the name") -> Callable[[str], N]:
    """Return an argument type that applies a check of protos/model/names.py; `what` begins the error."""

    def parse(text: str) -> N:
        try:
            return check(text, what)
        except DecodeError as error:
            raise argparse.ArgumentTypeError(str(error)) from error

    return parse


def number(least: float, most: float) -> Callable[[str], float]:
    """Return an argument type for a number from `least` to `most`, both finite."""

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
    """Return an argument type for a whole number from `least` to `most`."""
    digits = len(str(most))

    def read(text: str) -> int:
        # Python refuses to read thousands of digits, with an error of its own.
        if not (text.isascii() and text.isdigit() and len(text) <= digits and least <= int(text) <= most):
            raise argparse.ArgumentTypeError(f"expected a whole number from {least} to {most}, got {text!r}")
        return int(text)

    return read
