"""Formats the predictions as a table for a terminal, with a verdict on the target."""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.controlplane.cli.text_table import columns
from plr.controlplane.planning.prospects import least_set, paths_needed
from plr.protos.base.printable import escaped

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from plr.controlplane.planning.prospects import Prospect, Source

HEADER = ("INTERFACES", "SERVERS", "PRODUCT", "JOINT", "JOINT/PRODUCT", "BEST SET")


def render(source: Source, prospects: Sequence[Prospect], deadline_s: float, target: float | None) -> str:
    """Return what was recorded, a row for each set, and the verdict."""
    rows = [
        (
            str(found.interfaces),
            str(found.servers),
            f"{found.product:.2g}",
            f"{found.joint:.2g}",
            f"{found.joint / found.product:.2g}",
            found.paths,
        )
        for found in prospects
    ]
    head = [escaped(source.title), f"predicted probability to miss {deadline_s * 1e3:g} ms:", ""]
    lines = [*head, *columns([HEADER, *rows])]
    if target is not None:
        lines += ["", *verdict(source, prospects, target)]
    return "\n".join(lines)


def verdict(source: Source, prospects: Sequence[Prospect], target: float) -> Iterator[str]:
    """Yield the smallest set that meets the target; if there is none, by how much the best fails and what would do."""
    least = least_set(prospects, target)
    if least is not None:
        yield (
            f"least set for {target:g}: {_count(least.interfaces, 'interface')} and"
            f" {_count(least.servers, 'server')} ({least.paths}), predicted {least.joint:.2g}"
        )
        return
    if not prospects:
        yield "nothing was recorded to plan with"
        return
    best = min(prospects, key=lambda found: found.joint)
    yield (
        f"no set meets {target:g}: the best, {_count(best.interfaces, 'interface')} and"
        f" {_count(best.servers, 'server')} ({best.paths}), misses with probability {best.joint:.2g},"
        f" {best.joint / target:.2g} times the target"
    )
    if target * source.requests < 1.0:
        yield f"{source.requests:.0f} requests cannot show a probability of {target:g}: record more"
    single = min(prospects, key=lambda found: (found.interfaces, found.servers, found.joint))
    needed = paths_needed(single.joint, target)
    if needed is not None:
        yield f"{needed} paths as good as {single.paths} ({single.joint:.2g}) would do if they failed independently"


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'s' if number != 1 else ''}"
