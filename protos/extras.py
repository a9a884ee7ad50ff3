"""Which packages a program needs beyond the distribution's own dependencies: its extra in pyproject.toml."""

from __future__ import annotations

import importlib.util
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

SIDECAR = ("prometheus_client", "pyroute2", "sdnotify", "zfec")
CONTROL_PLANE = ("grpc_health", "grpc_reflection", "numpy", "ortools", "prometheus_client", "sdnotify")
PLAN = ("numpy",)


def missing(extra: str, modules: Sequence[str]) -> str | None:
    """Return one line that says what to install, None if all of these modules are there. Imports none of them."""
    absent = [module for module in modules if importlib.util.find_spec(module) is None]
    if not absent:
        return None
    return f"{', '.join(absent)} not installed: needs the extra {extra}; in the checkout: pip install '.[{extra}]'"
