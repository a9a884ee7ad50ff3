"""Rows of the page of limits get the figures of the constants that they name."""

from __future__ import annotations

import pytest

from deploy.dev.pages.limits import with_figures
from plr.protos.model.members import MAX_CREDENTIAL_BYTES, MAX_PEERS
from plr.sidecar.core.path.key_exchange import EXCHANGES_AT_ONCE, EXCHANGES_PER_S
from plr.sidecar.core.wire.messages import MAX_PAYLOAD_BYTES

EXCHANGES = "`sidecar/core/path/key_exchange.py` `EXCHANGES_AT_ONCE`, `EXCHANGES_PER_S`"


def row(limit: str, source: str) -> str:
    return f"| item | {limit} | effect, 7 of them | {source} |"


@pytest.mark.parametrize(
    ("limit", "source", "expected"),
    [
        ("1", "`protos/model/members.py` `MAX_PEERS`", str(MAX_PEERS)),
        ("1 MiB", "`sidecar/core/wire/messages.py` `MAX_PAYLOAD_BYTES`", f"{MAX_PAYLOAD_BYTES >> 20} MiB"),
        ("1 B", "`protos/model/members.py` `MAX_CREDENTIAL_BYTES`", f"{MAX_CREDENTIAL_BYTES} B"),
        ("0 at once, 0 per second", EXCHANGES, f"{EXCHANGES_AT_ONCE:g} at once, {EXCHANGES_PER_S:g} per second"),
        ("1 each, 3 of all", "`protos/model/members.py` `MAX_PEERS`", f"{MAX_PEERS} each, 3 of all"),
    ],
)
def test_figures_are_written_in_the_unit_of_the_row(limit: str, source: str, expected: str) -> None:
    assert with_figures(row(limit, source)) == row(expected, source)


def test_a_constant_that_moved_is_found() -> None:
    moved = row("1", "`protos/old/members.py` `MAX_PEERS`")
    assert with_figures(moved) == row(str(MAX_PEERS), "`protos/model/members.py` `MAX_PEERS`")


@pytest.mark.parametrize(
    ("limit", "source", "problem"),
    [
        ("1", "`protos/model/members.py` `MAX_NOTHING`", "found it in: none"),
        ("1", "`protos/old/gone.py` `RETRY_S`", "the file that defines RETRY_S"),
        ("1", "`protos/old/gone.py`", "expected a file"),
        ("many", "`protos/model/members.py` `MAX_PEERS`", "a figure for each of 1"),
    ],
)
def test_a_row_that_names_no_single_constant_is_refused(limit: str, source: str, problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        with_figures(row(limit, source))


@pytest.mark.parametrize("line", ["text", "| a | b |", "| --- | --- | --- | --- |", row("many", "no source")])
def test_other_lines_stay(line: str) -> None:
    assert with_figures(line) == line
