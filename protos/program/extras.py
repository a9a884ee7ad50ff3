"""Checks for the packages that a program needs: the distribution's dependencies and its extra in pyproject.toml."""

from __future__ import annotations

import contextlib
import importlib.util
import sys
from typing import TYPE_CHECKING

from plr.protos.program.endings import ended_by_ctrl_c
from plr.protos.program.exit_codes import EXIT_USAGE

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

BASE = ("cryptography", "google", "grpc", "pydantic", "yaml")
SIDECAR = ("prometheus_client", "pyroute2", "sdnotify", "zfec")
CONTROL_PLANE = ("grpc_health", "grpc_reflection", "numpy", "ortools", "prometheus_client", "sdnotify")
PLAN = ("numpy",)

_OURS = "plr"


def missing(extra: str, modules: Sequence[str]) -> str | None:
    """Return one line that says what to install, or None if all of these modules are there; import none of them."""
    absent = [module for module in (*BASE, *modules) if importlib.util.find_spec(module) is None]
    return advice(extra, absent) if absent else None


def advice(extra: str, absent: Sequence[str]) -> str:
    """Return one line that says what to install for these modules of an extra."""
    return f"{', '.join(absent)} not installed: needs the extra {extra}; in the checkout: pip install '.[{extra}]'"


@contextlib.contextmanager
def required(program: str, extra: str) -> Iterator[None]:
    """End the program with a line that says what to install, if an import in the block fails for a missing package."""
    try:
        with ended_by_ctrl_c():
            yield
    except ModuleNotFoundError as error:
        name = (error.name or "").partition(".")[0]
        if not name or name == _OURS:
            raise
        sys.stderr.write(f"{program}: {advice(extra, [name])}\n")
        sys.exit(EXIT_USAGE)
