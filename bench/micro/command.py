"""`python -m bench micro`: shows how many calls, functions and files a request passes through in both joined cores."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.console import Console

from bench.micro.request_walk import Leg, both_cores, walk_of_a_request
from bench.reporting.tables import Table
from bench.reporting.terminal import rich_table

if TYPE_CHECKING:
    import argparse


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `python -m bench micro`."""
    parser.add_argument("--calls", action="store_true", help="list the calls of each leg, in order")


def run(options: argparse.Namespace) -> int:
    """Count, print the table, and return the exit code."""
    console = Console(highlight=False)
    legs = walk_of_a_request()
    if options.calls:
        for leg in legs:
            console.print(f"{leg.name}", style="bold")
            for call in leg.calls:
                console.print(f"  {call.file} {call.function}", soft_wrap=True, markup=False)
    console.print(rich_table(_table(legs)))
    return 0


def _table(legs: list[Leg]) -> Table:
    rows = tuple(
        (leg.name, len(leg.calls), leg.functions, len(leg.files), leg.changes) for leg in (*legs, both_cores(legs))
    )
    columns = ("leg", "calls", "functions", "files", "changes of file")
    return Table("1 kB request and 1 kB answer, one interface, one server, warm", columns, rows)
