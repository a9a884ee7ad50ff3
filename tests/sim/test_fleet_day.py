"""Half a day of a small fleet with all that a day brings, cut to seconds; and the checks, on what they must find.

The whole day of a fleet of 1,000 is `make bench-fleet-day`.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import pytest

from bench.fleetday.day import Day, Scale
from bench.fleetday.held import HeldPeers
from bench.fleetday.line import Line
from bench.fleetday.sizes import Sizes, grown, measure
from plr.controlplane.core.formulation.problem_builder import Drawing
from plr.controlplane.core.publish.snapshots import Track
from plr.controlplane.core.publish.views import Views
from plr.controlplane.core.registry.registry import Registry
from plr.protos.model.status import SyncState

if TYPE_CHECKING:
    from pathlib import Path

    from plr.controlplane.core.publish.snapshots import VersionSource
    from plr.protos.model.ids import Version
    from plr.protos.model.members import PeerSet

pytestmark = pytest.mark.audit("ops-24h")

SMALL = Scale(
    members=24,
    hours=0.4,
    every_hours=0.2,
    moment_s=10.0,
    events=3,
    grid_s=0.0,
    look_s=60.0,
    measures_s=120.0,
    slack=120,
    restarts=2,
)
SHORT = dataclasses.replace(SMALL, members=12, hours=0.2, every_hours=0.2, moment_s=5.0, restarts=0)


@pytest.mark.parametrize("seed", [1, 2])
def test_nothing_drifts_and_nothing_grows(seed: int, tmp_path: Path) -> None:
    day = Day(seed, SMALL, tmp_path)
    day.run()
    assert day.checker.complaints == []
    assert day.grown() == []
    assert day.happened.total() > 60
    # The checks had somebody to judge: nearly everybody in each quiet time.
    assert min(sample.judged / sample.registered for sample in day.samples) > 0.6
    assert day.judged_at_last > 0.6 * day.last_members
    assert day.checker.compared > 1000


def complaints(folder: Path) -> list[str]:
    day = Day(7, SHORT, folder)
    day.run()
    return day.checker.complaints


def test_a_set_that_is_taken_and_not_applied_is_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    applied = HeldPeers.apply

    def lost(self: HeldPeers, message: PeerSet) -> None:
        before = self.table
        applied(self, message)
        if len(before) == 5:
            self._table = dict(before)

    monkeypatch.setattr(HeldPeers, "apply", lost)
    assert any("holds" in complaint for complaint in complaints(tmp_path))


def test_a_lease_that_never_ends_is_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Registry, "expire", lambda self, now, unread: [])
    monkeypatch.setattr(Registry, "next_expiry", lambda self: None)
    found = complaints(tmp_path)
    assert any("is registered, and gone" in complaint for complaint in found)
    assert any("still holds" in complaint for complaint in found)


def test_a_version_that_is_never_sent_is_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever else is news, the robots stay the same for the servers."""
    monkeypatch.setattr(Views, "_robots_for", lambda self, cloud: ())
    assert any("does not hold" in complaint for complaint in complaints(tmp_path))


def test_what_is_taken_for_synced_without_being_so_is_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    send = Track.send

    def believing(self: Track[object], content: object, versions: VersionSource) -> Version:
        version = send(self, content, versions)
        self.state = SyncState.SYNCED
        return version

    monkeypatch.setattr(Track, "send", believing)
    day = Day(7, SHORT, tmp_path)
    day.timeline.after(300.0, day.refuse_all)
    day.run()
    assert any("believed to hold" in complaint for complaint in day.checker.complaints)


def test_a_member_that_has_not_heard_yet_of_the_end_of_its_stream_is_not_judged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The fleet of 1,000 met a look within these milliseconds once in a day."""
    day = Day(7, SHORT, tmp_path)
    end = Line._end
    ends = 0

    def end_and_look(self: Line, *, refused: bool) -> None:
        nonlocal ends
        end(self, refused=refused)
        ends += 1
        day.checker.look(day.timeline.now)

    monkeypatch.setattr(Line, "_end", end_and_look)
    day.run()
    assert ends > 5
    assert [one for one in day.checker.complaints if "believes that it is registered" in one] == []


def test_a_table_that_is_never_pruned_is_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Drawing, "_forget_others", lambda self, uses: None)
    day = Day(7, dataclasses.replace(SHORT, hours=0.9, every_hours=0.3), tmp_path)
    day.run()
    first, *_, last = (sample.sizes.entries["_drawing._drawn"] for sample in day.samples)
    assert last > 1.3 * first


def test_sizes_are_counted_once_and_by_table() -> None:
    class Root:
        def __init__(self) -> None:
            shared = {"a": [1, 2], "b": [3]}
            self.one = shared
            self.other = shared
            self.more = [{"c": "x" * 100}]

    sizes = measure(Root())
    assert sizes.entries == {"one": 2, "one[]": 3, "more": 1, "more[]": 1}
    assert sizes.bytes["other"] == 0
    assert sizes.bytes["more"] > 100


def test_growth_is_told_from_change() -> None:
    def samples(*counts: int, name: str = "table") -> list[Sizes]:
        return [Sizes({name: count, "kept": count * 10}) for count in counts]

    assert grown(samples(100, 120, 110, 100, 125), share=0.3, slack=10, capped={"kept": 2000}) == []
    assert grown(samples(100, 120, 180, 200, 225), share=0.3, slack=10, capped={"kept": 3000}) == [
        "table grows: [100, 120, 180, 200, 225]"
    ]
    assert grown(samples(100, 120, 110, 100), share=0.3, slack=10, capped={"kept": 1000, "table": 120}) == [
        "kept is above its cap of 1000: [1000, 1200, 1100, 1000]"
    ]
    within = [Sizes({"kept": 10 * n, "kept[].of": 10 * n * n}) for n in (1, 2, 5, 10)]
    assert [line.split(" grows")[0] for line in grown(within, share=0.3, slack=10, capped={"kept": 2000})] == [
        "kept[].of"
    ]
