"""Writes the figures of the constants that a row of limits.md names into the row, and where they are now.

The last column of a row names constants: `` `sidecar/net/sockets.py` `ADDRESS_CACHE_ENTRIES` ``. The second column
begins with their figures, in the same order; its words and the units are the author's.
"""

from __future__ import annotations

import ast
import functools
import re
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

ROOT = Path(__file__).parents[3]

_PACKAGES = ("sidecar", "controlplane", "protos")
_SOURCE = re.compile(r"`([\w/]+\.py|[A-Z][A-Z_0-9]*)`")
_FIGURE = re.compile(r"(\d[\d.]*)( (?:B|kB|KiB|MiB|s|ms|min)\b)?")
_UNITS = {"B": 1, "kB": 1000, "KiB": 1024, "MiB": 1 << 20, "s": 1, "ms": 1e-3, "min": 60}
_LIMIT, _SOURCES = 1, 3


def with_figures(page: str) -> str:
    """Return the page of limits as the code has them; raise ValueError for a row that names no single constant."""
    return "\n".join(_with_figures(line) for line in page.split("\n"))


def _with_figures(line: str) -> str:
    cells = line.removeprefix("| ").removesuffix(" |").split(" | ")
    if not line.startswith("| ") or len(cells) != 4 or not _SOURCE.match(cells[_SOURCES]):
        return line
    constants = list(_constants_named(cells[_SOURCES]))
    if not constants and not (ROOT / cells[_SOURCES].strip("`")).is_file():
        raise ValueError(f"expected a file, got {cells[_SOURCES]}")
    if constants:
        values = [_constants_of(file)[name] for file, name in constants]
        cells[_LIMIT] = _with_values(cells[_LIMIT], values)
        cells[_SOURCES] = _sources(constants)
    return f"| {' | '.join(cells)} |"


def _constants_named(cell: str) -> Iterator[tuple[str, str]]:
    file = ""
    for word in _SOURCE.findall(cell):
        if word.endswith(".py"):
            file = word
        else:
            yield _file_of(word, file), word


def _file_of(name: str, file: str) -> str:
    """Return the file that defines the constant; when it has moved, the one to which it can only have moved."""
    if (ROOT / file).is_file() and name in _constants_of(file):
        return file
    found = [path for path in _files() if name in _constants_of(path)]
    same = [path for path in found if Path(path).name == Path(file).name]
    if len(same or found) != 1:
        raise ValueError(
            f"expected the file that defines {name}, got {file}; found it in: {', '.join(found) or 'none'}"
        )
    return (same or found)[0]


def _sources(constants: list[tuple[str, str]]) -> str:
    """Name each file once, before its constants."""
    words: list[str] = []
    for index, (file, name) in enumerate(constants):
        known = index > 0 and constants[index - 1][0] == file
        words.append(f"`{name}`" if known else f"`{file}` `{name}`")
    return ", ".join(words)


def _with_values(cell: str, values: list[float]) -> str:
    """Write the values over the first figures; raise ValueError if there are fewer figures."""
    left = iter(values)
    if len(_FIGURE.findall(cell)) < len(values):
        raise ValueError(f"expected a figure for each of {len(values)} constants, got {cell!r}")
    return _FIGURE.sub(lambda match: _in_unit(next(left), match[2] or ""), cell, count=len(values))


def _in_unit(value: float, unit: str) -> str:
    number = value / _UNITS[unit.strip()] if unit else value
    return f"{int(number) if number == int(number) else number}{unit}"


@functools.cache
def _files() -> tuple[str, ...]:
    return tuple(
        str(path.relative_to(ROOT)) for package in _PACKAGES for path in sorted((ROOT / package).rglob("*.py"))
    )


@functools.cache
def _constants_of(file: str) -> dict[str, float]:
    """Return the module-level constants that are numbers, or arithmetic on numbers and on such constants.

    The module is not imported: some need ROS.
    """
    found: dict[str, float] = {}
    imported: dict[str, float] = {}
    for node in ast.parse((ROOT / file).read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom):
            imported.update(_imported_by(node))
        elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            known = imported | found
            parts = list(ast.walk(node.value))
            names = {part.id for part in parts if isinstance(part, ast.Name)}
            if names <= known.keys() and not any(isinstance(part, ast.Call) for part in parts):
                value = eval(compile(ast.Expression(node.value), file, "eval"), known)  # noqa: S307 - our own arithmetic
                if isinstance(value, int | float):
                    found[node.targets[0].id] = value
    return found


def _imported_by(node: ast.ImportFrom) -> dict[str, float]:
    """Return the constants among what this statement imports from our packages."""
    file = f"{(node.module or '').removeprefix('plr.').replace('.', '/')}.py"
    names = [one.name for one in node.names if one.name.isupper()]
    if not names or not (ROOT / file).is_file():
        return {}
    constants = _constants_of(file)
    return {name: constants[name] for name in names if name in constants}
