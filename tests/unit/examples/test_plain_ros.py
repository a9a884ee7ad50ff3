"""The examples are plain ROS 2 applications: nothing in them is of FogROS2-PLR."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[3] / "examples"
SOURCES = sorted(EXAMPLES.rglob("*.py"))
OURS = {"plr", "sidecar", "controlplane", "protos", "lab", "bench", "tests"}


def imported(source: str) -> set[str]:
    """Top-level names of all imports in a source text."""
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module.partition(".")[0])
    return names


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(EXAMPLES)))
def test_an_example_imports_nothing_of_ours(path: Path) -> None:
    assert not imported(path.read_text()) & OURS


def test_the_check_would_find_such_an_import() -> None:
    assert len(SOURCES) >= 10
    assert imported("def f():\n    from plr.sidecar.core import engine\n    import lab.system") == {"plr", "lab"}
