"""The log of events outlives the program, full disks and damaged lines."""

from __future__ import annotations

import errno
import fcntl
import os
import subprocess
import threading
import time
from typing import IO, TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from plr.controlplane.core.explain import event_memory
from plr.controlplane.observe import event_log
from plr.controlplane.observe.event_lines import decode, encode
from plr.controlplane.observe.event_log import FILE, EventLog
from plr.controlplane.observe.remembered import departures
from plr.protos.base.errors import DecodeError
from plr.protos.model.fleet_events import EventKind, EventQuery, FleetEvent, Why
from plr.protos.model.ids import NodeName, Role
from plr.protos.program import own_folder

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

pytestmark = pytest.mark.audit("ops-11")

ROBOT = NodeName("robot")
PATIENCE_S = 30.0


def wait_for(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def write(folder: Path, count: int = 3) -> list[FleetEvent]:
    log = EventLog(folder)
    for number in range(count):
        log.record(EventKind.CONNECTED, NodeName(f"robot-{number}"), "software 1", role=Role.ROBOT)
    log.record(EventKind.DEPARTED, ROBOT, role=Role.ROBOT, why=Why.REVOKED)
    written = log.events()
    log.close()
    return written


def test_it_survives_a_restart_and_its_numbers_only_grow(tmp_path: Path) -> None:
    written = write(tmp_path / "state")
    log = EventLog(tmp_path / "state")
    assert [event.number for event in log.events()] == [event.number for event in written]
    assert [(event.node, event.why) for event in log.events()] == [(event.node, event.why) for event in written]
    log.record(EventKind.STOPPED)
    assert log.events()[-1].number > written[-1].number
    log.close()


def test_damaged_lines_are_skipped_counted_and_not_written_again(tmp_path: Path) -> None:
    written = write(tmp_path)
    lines = (tmp_path / FILE).read_bytes().splitlines(keepends=True)
    damaged = [
        lines[0],
        b'{"number": 1',
        lines[1].replace(b"connected", b"conn\xffcted"),
        b"\0" * 50 + b"\n",
        *lines[2:],
    ]
    (tmp_path / FILE).write_bytes(b"".join(damaged) + lines[0][:20])
    log = EventLog(tmp_path)
    # One cut off amid a line takes the one behind it along.
    assert log.state.damaged == 3
    assert [event.number for event in log.events()] == [written[0].number, *(event.number for event in written[2:])]
    log.record(EventKind.STARTED)
    log.close()
    again = EventLog(tmp_path)
    assert again.state.damaged == 0
    assert len(again.events()) == len(written)
    again.close()


def test_a_line_without_its_end_does_not_swallow_the_next(tmp_path: Path) -> None:
    written = write(tmp_path)
    content = (tmp_path / FILE).read_bytes()
    (tmp_path / FILE).write_bytes(content.removesuffix(b"\n"))
    write(tmp_path, count=0)
    log = EventLog(tmp_path)
    assert len(log.events()) == len(written) + 1
    log.close()


def test_a_full_disk_costs_nothing_but_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    full = threading.Event()
    real = own_folder.write_through

    def write_through(file: IO[bytes], data: bytes) -> None:
        if full.is_set():
            real(file, data[: len(data) // 2])
            raise OSError(errno.ENOSPC, "No space left on device")
        real(file, data)

    monkeypatch.setattr(own_folder, "write_through", write_through)
    log = EventLog(tmp_path, retry_s=0.05)
    log.record(EventKind.STARTED)
    wait_for(lambda: (tmp_path / FILE).exists())
    full.set()
    for number in range(5):
        log.record(EventKind.CONNECTED, NodeName(f"robot-{number}"), role=Role.ROBOT)
    wait_for(lambda: log.state.write_failures > 1)
    assert not log.state.on_disk
    assert "No space left" in log.state.problem
    assert not (tmp_path / f"{FILE}.new").exists()
    full.clear()
    wait_for(lambda: log.state.on_disk)
    log.close()
    again = EventLog(tmp_path)
    assert [event.node for event in again.events()] == [None, *(f"robot-{number}" for number in range(5))]
    assert again.state.damaged == 0
    again.close()


@pytest.mark.audit("ops-16")
@pytest.mark.parametrize("wrong", [1, 1 << 60])
@pytest.mark.parametrize("place", range(4))
def test_a_wrong_number_costs_one_event(tmp_path: Path, wrong: int, place: int) -> None:
    written = write(tmp_path)
    lines = (tmp_path / FILE).read_bytes().splitlines(keepends=True)
    lines[place] = lines[place].replace(str(written[place].number).encode(), str(wrong).encode())
    (tmp_path / FILE).write_bytes(b"".join(lines))
    log = EventLog(tmp_path)
    # One that is still in order cannot be told from a right one, and may stand in place of one.
    assert log.state.damaged <= 1
    kept = [event.number for event in log.events()]
    assert len(kept) + log.state.damaged == len(written)
    assert kept == sorted(kept)
    assert {event.number for event in written[max(place, 1) + 1 :]} <= set(kept)
    log.close()


def test_the_file_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(event_log, "MAX_EVENT_FILE_BYTES", 20_000)
    monkeypatch.setattr("plr.controlplane.core.explain.event_memory.MAX_EVENTS", 50)
    log = EventLog(tmp_path)
    for number in range(2000):
        log.record(EventKind.CONNECTED, NodeName(f"robot-{number}"), "x" * 100, role=Role.ROBOT)
        if not number % 50:
            wait_for(lambda: not log._unwritten)
            assert (tmp_path / FILE).stat().st_size < 20_000 + 50 * 300
    log.close()
    again = EventLog(tmp_path)
    assert again.events()[-1].node == "robot-1999"
    again.close()


def test_a_folder_in_use_or_out_of_reach_leaves_it_in_memory(tmp_path: Path) -> None:
    first = EventLog(tmp_path / "state")
    second = EventLog(tmp_path / "state")
    assert "another control plane" in second.state.problem
    (tmp_path / "file").write_text("")
    third = EventLog(tmp_path / "file" / "state")
    assert third.state.problem
    for log in (second, third):
        log.record(EventKind.STARTED)
        assert log.state.kept == 1
        assert not log.state.on_disk
        log.close()
    first.close()


def test_a_file_that_somebody_removed_is_made_again(tmp_path: Path) -> None:
    log = EventLog(tmp_path, retry_s=0.05)
    log.record(EventKind.STARTED)
    wait_for(lambda: (tmp_path / FILE).exists())
    (tmp_path / FILE).unlink()
    log.record(EventKind.STOPPED)
    wait_for(lambda: (tmp_path / FILE).exists() and log.state.on_disk)
    log.close()
    again = EventLog(tmp_path)
    assert [event.kind for event in again.events()] == [EventKind.STARTED, EventKind.STOPPED]
    again.close()


def test_what_was_left_out_of_a_members_share_is_said(tmp_path: Path) -> None:
    now = 0.0
    log = EventLog(None, clock=lambda: now)
    for _ in range(200):
        log.record(EventKind.CONNECTED, ROBOT, role=Role.ROBOT)
    now = 60.0
    log.record(EventKind.CONNECTED, ROBOT, role=Role.ROBOT)
    left_out = log.state.too_often
    assert left_out > 100
    assert f"and {left_out} earlier events" in log.events()[-1].text


def test_refusals_under_a_name_are_told_seldom_and_take_nothing_of_its_owner() -> None:
    now = 0.0
    log = EventLog(None, clock=lambda: now)
    for _ in range(1000):
        log.record_refusal(ROBOT, "NAME_TAKEN", "registration: taken")
    assert [event.text for event in log.events()] == ["registration: taken"]
    assert log.state.too_often == 999
    log.record(EventKind.NACK, ROBOT, "no", role=Role.ROBOT)
    assert log.events()[-1].text == "no"
    now = 61.0
    log.record_refusal(ROBOT, "NAME_TAKEN", "registration: taken")
    assert log.events()[-1].text == "registration: taken (and 999 earlier times that were too many to keep)"
    assert log.events()[-1].kind is EventKind.REFUSED


@pytest.mark.skipif(os.geteuid() != 0, reason="mounting takes root")
@pytest.mark.parametrize("lock", [True, False])
def test_a_folder_that_was_read_only_at_the_start_is_read_and_written_once_it_can_be(
    tmp_path: Path, *, lock: bool
) -> None:
    folder = tmp_path / "state"
    written = write(folder)
    if not lock:
        (folder / event_log.LOCK_FILE).unlink()
    subprocess.run(["mount", "--bind", folder, folder], check=True)
    try:
        subprocess.run(["mount", "-o", "remount,ro,bind", folder], check=True)
        log = EventLog(folder, retry_s=0.05)
        assert [event.number for event in log.events()] == [event.number for event in written]
        log.record(EventKind.STARTED)
        wait_for(lambda: log.state.write_failures > 0)
        assert not log.state.on_disk
        subprocess.run(["mount", "-o", "remount,rw,bind", folder], check=True)
        wait_for(lambda: log.state.on_disk)
        log.close()
        again = EventLog(folder)
        assert len(again.events()) == len(written) + 1
        again.close()
    finally:
        subprocess.run(["umount", folder], check=True)


def flaps(log: EventLog, times: int) -> None:
    for _ in range(times):
        log.record(EventKind.STREAM_LOST, ROBOT, role=Role.ROBOT)
        log.record(EventKind.CONNECTED, ROBOT, role=Role.ROBOT)


def after_a_restart(folder: Path) -> tuple[list[Why], list[NodeName]]:
    """Return why members are gone, and who is awaited."""
    log = EventLog(folder)
    gone, present = departures(log.events(), ran_until=log.ran_until, now_wall=time.time(), now=1000.0)
    log.close()
    return [one.why for one in gone], [one.name for one in present]


@pytest.mark.parametrize("stopped", [True, False])
def test_a_member_that_flapped_is_after_a_restart_what_it_was_before(tmp_path: Path, *, stopped: bool) -> None:
    now = 0.0
    log = EventLog(tmp_path, clock=lambda: now)
    if stopped:
        flaps(log, 500)
        log.record(EventKind.DEPARTED, ROBOT, role=Role.ROBOT, why=Why.DRAINED, seen_s=3.0)
    else:
        log.record(EventKind.DEPARTED, ROBOT, role=Role.ROBOT, why=Why.DRAINED)
        flaps(log, 500)
    log.close()
    assert after_a_restart(tmp_path) == (([Why.DRAINED], []) if stopped else ([], [ROBOT]))


def test_the_last_change_of_a_member_that_flapped_is_written_before_long(tmp_path: Path) -> None:
    now = 0.0
    log = EventLog(tmp_path, clock=lambda: now)
    flaps(log, 500)
    log.record(EventKind.DEPARTED, ROBOT, role=Role.ROBOT, why=Why.DRAINED)
    kept = len(log.events())
    log.keep_held()
    assert len(log.events()) == kept, "its share is spent"
    now = 1.0 / event_memory.PRESENCE_PER_S
    log.keep_held()
    last = log.events()[-1]
    assert (last.kind, last.why) == (EventKind.DEPARTED, Why.DRAINED)
    assert f"and {log.state.too_often} earlier events" in last.text
    assert log.state.too_often + len(log.events()) == 1001
    log.keep_held()
    assert log.events()[-1] is last
    log.close()


def test_what_waits_goes_before_another_event_of_its_member() -> None:
    now = 0.0
    log = EventLog(None, clock=lambda: now)
    flaps(log, 500)
    log.record(EventKind.STREAM_LOST, ROBOT, role=Role.ROBOT)
    now = 1.0 / event_memory.EVENTS_PER_S
    log.record(EventKind.REFUSED, ROBOT, "registration: too often")
    assert [event.kind for event in log.events()[-2:]] == [EventKind.STREAM_LOST, EventKind.REFUSED]
    numbers = [event.number for event in log.events()]
    assert numbers == sorted(set(numbers))


def test_a_question_is_answered_with_what_it_asks_for() -> None:
    wall = 1000.0
    log = EventLog(None, wall=lambda: wall)
    for number in range(10):
        wall = 1000.0 + number
        log.record(EventKind.CONNECTED, NodeName(f"robot-{number % 2}"), role=Role.ROBOT)
    events = log.events()
    assert log.find(EventQuery()) == (events, 0)
    assert log.find(EventQuery(last=3)) == (events[-3:], 7)
    assert log.find(EventQuery(node=NodeName("robot-1"))) == (events[1::2], 0)
    assert log.find(EventQuery(since=1007.0)) == (events[7:], 0)
    assert log.find(EventQuery(after=events[8].number)) == (events[9:], 0)


@given(st.binary(max_size=200))
def test_any_line_is_an_event_or_refused(line: bytes) -> None:
    try:
        event = decode(line)
    except DecodeError:
        return
    assert decode(encode(event).encode()) == event


def test_who_was_gone_and_who_was_there_follows_from_it() -> None:
    def event(number: int, kind: EventKind, node: str, why: Why | None = None) -> FleetEvent:
        return FleetEvent(number, 100.0 + number, kind, NodeName(node), "", Role.ROBOT, why)

    events = [
        event(1, EventKind.CONNECTED, "there"),
        event(2, EventKind.CONNECTED, "gone"),
        event(3, EventKind.DEPARTED, "gone", Why.REVOKED),
        event(4, EventKind.DEPARTED, "back", Why.LEASE_EXPIRED),
        event(5, EventKind.CONNECTED, "back"),
        event(6, EventKind.REFUSED, "gone"),
        event(7, EventKind.REFUSED, "stranger"),
    ]
    gone, present = departures(events, ran_until=197.0, now_wall=207.0, now=50.0)
    assert [(one.name, one.why, one.at) for one in gone] == [("gone", Why.REVOKED, 50.0 - 104.0)]
    assert [(one.name, one.seen_at) for one in present] == [("there", 40.0), ("back", 40.0)]


def test_it_knows_when_the_run_before_ended_also_if_nothing_happened_for_long(tmp_path: Path) -> None:
    wall = 1_000_000.0
    log = EventLog(tmp_path, wall=lambda: wall)
    assert log.ran_until is None
    log.record(EventKind.CONNECTED, ROBOT, role=Role.ROBOT)
    wait_for(lambda: (tmp_path / FILE).exists())
    wall += 30 * 3600.0
    log._touch()
    # As after a kill: the file says no more, and another process may have the lock.
    assert log._lock is not None
    fcntl.flock(log._lock, fcntl.LOCK_UN)
    wall += 60.0
    again = EventLog(tmp_path, wall=lambda: wall)
    assert again.ran_until == wall - 60.0
    _, present = departures(again.events(), ran_until=again.ran_until, now_wall=wall, now=500.0)
    assert [(one.name, one.seen_at) for one in present] == [(ROBOT, 440.0)]
    again.close()
    log.close()


def test_when_one_was_seen_last_outlives_a_restart(tmp_path: Path) -> None:
    wall = 1_000_000.0
    log = EventLog(tmp_path, wall=lambda: wall)
    log.record(EventKind.DEPARTED, ROBOT, role=Role.ROBOT, why=Why.LEASE_EXPIRED, seen_s=3600.0)
    log.close()
    again = EventLog(tmp_path, wall=lambda: wall)
    ((gone,), present) = departures(again.events(), ran_until=again.ran_until, now_wall=wall + 100.0, now=0.0)
    assert (gone.at, gone.seen_at, present) == (-100.0, -3700.0, [])
    again.close()
