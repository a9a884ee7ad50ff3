"""What the control plane loads before its fleet is back."""

from __future__ import annotations

import subprocess
import sys

import pytest

_STARTS_AND_SOLVES = """
import sys
import plr.controlplane.__main__, plr.controlplane.serve.server
from plr.controlplane.solver.matcher import Matcher
from plr.controlplane.core.problem.problem import Problem
Matcher().solve(Problem(()), time_limit_s=1.0)
assert "ortools" not in sys.modules and "pandas" not in sys.modules
from plr.controlplane.solver import cp_sat
cp_sat.prepare()
assert "ortools" in sys.modules
"""


@pytest.mark.audit("ops-16")
def test_the_solver_s_library_is_not_loaded_before_there_is_time_for_it() -> None:
    """Its import takes longer than half of the small fleet's return."""
    subprocess.run([sys.executable, "-c", _STARTS_AND_SOLVES], check=True)
