"""A refusal that comes again and again is told once."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from plr.protos.model.stream import ResourceKind
from plr.sidecar.control.refusal_log import RefusalLog

if TYPE_CHECKING:
    import pytest

PEERS, MAPPING = ResourceKind.PEERS, ResourceKind.MAPPING


def lines(caplog: pytest.LogCaptureFixture) -> list[tuple[int, str]]:
    told = [(record.levelno, record.getMessage()) for record in caplog.records if record.levelno >= logging.INFO]
    caplog.clear()
    return told


def test_a_reason_is_told_once_until_it_changes_or_something_is_taken(caplog: pytest.LogCaptureFixture) -> None:
    refusals = RefusalLog(logging.getLogger("test"))
    for version in range(3):
        refusals.refused(MAPPING, f"mapping version {version}", "no interface")
    assert lines(caplog) == [(logging.WARNING, "refused mapping version 0: no interface")]
    refusals.refused(PEERS, "peers version 3", "no interface")
    refusals.refused(MAPPING, "mapping version 4", "no peer")
    assert [text for _, text in lines(caplog)] == [
        "refused peers version 3: no interface",
        "refused mapping version 4: no peer",
    ]
    refusals.taken(MAPPING)
    refusals.refused(MAPPING, "mapping version 5", "no peer")
    refusals.refused(PEERS, "peers version 6", "no interface")
    assert [text for _, text in lines(caplog)] == ["refused mapping version 5: no peer"]


def test_a_fault_of_ours_is_an_error_with_its_traceback(caplog: pytest.LogCaptureFixture) -> None:
    refusals = RefusalLog(logging.getLogger("test"))
    refusals.refused(PEERS, "peers version 1", "internal error: x", ValueError("x"))
    assert caplog.records[0].exc_info is not None
    assert lines(caplog) == [(logging.ERROR, "refused peers version 1: internal error: x")]


def test_what_is_of_no_known_resource_is_always_told(caplog: pytest.LogCaptureFixture) -> None:
    refusals = RefusalLog(logging.getLogger("test"))
    for _ in range(2):
        refusals.refused(None, "a message of the control plane", "no kind")
    assert len(lines(caplog)) == 2
