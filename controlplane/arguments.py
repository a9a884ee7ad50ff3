"""What the commands of `plr` have in common in reading their arguments."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, TypeVar

from protos.errors import DecodeError

if TYPE_CHECKING:
    from collections.abc import Callable

    Commands = argparse._SubParsersAction[argparse.ArgumentParser]

N = TypeVar("N")


def checked_name(check: Callable[[str, str], N]) -> Callable[[str], N]:
    """An argument's type: a name that passes one of the checks of protos/names.py."""

    def parse(text: str) -> N:
        try:
            return check(text, "the name")
        except DecodeError as error:
            raise argparse.ArgumentTypeError(str(error)) from error

    return parse
