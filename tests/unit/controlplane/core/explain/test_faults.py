"""Which interfaces count as flapping or useless, and whom that is not to be blamed on."""

from __future__ import annotations

import pytest

from plr.controlplane.cli.status_table import render
from plr.controlplane.core.control.events import FaultNotice, Settings
from plr.controlplane.core.explain.faults import (
    FLAP_WINDOW_S,
    FLAPS,
    LOOK_EVERY_S,
    MAX_PATHS_LOOKED_AT,
    MAX_WATCHED_INTERFACES,
    USELESS_AFTER_S,
    Faults,
)
from plr.protos.model.ids import InterfaceName, NodeName
from plr.protos.model.members import CandidateSet, InterfaceLabel
from plr.protos.model.report import PathReport, Report
from plr.protos.model.status import Fault
from tests.support.control_world import SETTLED_S, SimSidecar, World
from tests.support.samples import histogram, interfaces, path

NAMES = ("a", "b")
ROBOT = NodeName("robot")
EVERY_S = 5.0
"""Between two reports."""


class Fleet:
    """A robot with two interfaces and two servers, which reports again and again; collects the notices."""

    def __init__(self) -> None:
        self.world = World(Settings(warm_up_s=0.0))
        for name in NAMES:
            self.world.cloud(name)
        self.robot: SimSidecar = self.world.robot()
        self.notices: list[FaultNotice] = []
        real = self.world.core.next_event

        def noticed() -> object:
            event = real()
            if isinstance(event, FaultNotice):
                self.notices.append(event)
            return event

        self.world.core.next_event = noticed  # type: ignore[assignment,method-assign]

    def reports(self, *paths: PathReport, changes_only: bool = False) -> None:
        self.world.say(self.robot, Report(paths=paths, changes_only=changes_only))
        self.world.run(EVERY_S)

    def steady(self, seconds: float) -> None:
        for _ in range(round(seconds / EVERY_S)):
            self.reports(*(fine(nic, server) for nic in ("wlan0", "wwan0") for server in NAMES))

    @property
    def told(self) -> list[tuple[str, Fault, bool]]:
        return [(one.found.interface, one.found.fault, one.over) for one in self.notices]

    def faults(self) -> list[tuple[str, Fault]]:
        (status,) = self.world.core.status(self.world.now, [ROBOT])
        return [(one.interface, one.fault) for one in status.faults]


def fine(nic: str, server: str, *, up: bool = True) -> PathReport:
    return path(nic, server, up=up, rtt=histogram(0.02))


def test_an_interface_whose_paths_go_up_and_down_is_told_once_and_again_when_it_is_steady() -> None:
    fleet = Fleet()
    fleet.steady(20.0)
    for number in range(2 * FLAPS):
        both = [fine("wwan0", server, up=bool(number % 2)) for server in NAMES]
        fleet.reports(*both, *(fine("wlan0", server) for server in NAMES))
    assert fleet.told == [("wwan0", Fault.FLAPPING, False)]
    assert fleet.faults() == [("wwan0", Fault.FLAPPING)]
    (status,) = fleet.world.core.status(fleet.world.now, [ROBOT], abridged=True)
    assert not status.abridged
    assert "wwan0 FLAPPING: " in render([status])
    fleet.steady(FLAP_WINDOW_S + 2 * EVERY_S)
    assert fleet.told == [("wwan0", Fault.FLAPPING, False), ("wwan0", Fault.FLAPPING, True)]
    assert fleet.faults() == []


def test_one_tunnel_is_none() -> None:
    fleet = Fleet()
    fleet.steady(20.0)
    for up in (False, False, True, False, True):
        fleet.reports(*(fine(nic, server, up=up) for nic in ("wlan0", "wwan0") for server in NAMES))
    fleet.steady(60.0)
    assert fleet.told == []


def test_short_reports_of_changes_alone_count_too() -> None:
    fleet = Fleet()
    fleet.steady(20.0)
    for number in range(2 * FLAPS):
        fleet.reports(fine("wwan0", "a", up=bool(number % 2)), changes_only=True)
    fleet.steady(EVERY_S)
    assert fleet.told == [("wwan0", Fault.FLAPPING, False)]


def test_a_server_that_comes_and_goes_over_several_interfaces_is_to_blame_itself() -> None:
    fleet = Fleet()
    fleet.steady(20.0)
    for number in range(2 * FLAPS):
        up = bool(number % 2)
        fleet.reports(*(fine(nic, "a", up=up) for nic in ("wlan0", "wwan0")), fine("wlan0", "b"), fine("wwan0", "b"))
    assert fleet.told == []
    assert fleet.world.core.faults.restless_servers(ROBOT) == {"a"}
    view = fleet.world.core.view(ROBOT, fleet.world.now)
    assert view is not None
    assert view.restless == {"a"}


def test_an_interface_whose_link_comes_and_goes_is_flapping() -> None:
    fleet = Fleet()
    fleet.steady(20.0)
    down = (InterfaceLabel(InterfaceName("wwan0")),)
    for number in range(2 * FLAPS):
        gone = number % 2 == 0
        told = CandidateSet(interfaces("wlan0"), down=down) if gone else CandidateSet(interfaces("wlan0", "wwan0"))
        fleet.world.say(fleet.robot, told)
        fleet.steady(EVERY_S)
    assert fleet.told == [("wwan0", Fault.FLAPPING, False)]
    assert fleet.faults() == [("wwan0", Fault.FLAPPING)]
    view = fleet.world.core.view(ROBOT, fleet.world.now)
    assert view is not None
    assert {one.name: one.faults for one in view.interfaces} == {"wlan0": frozenset(), "wwan0": {Fault.FLAPPING}}


def useless(nic: str, server: str, *, lost: bool) -> PathReport:
    """Up, but it loses four probes of five, or takes longer than any deadline."""
    rtt = histogram(0.02) if lost else histogram(3.0)
    if lost:
        rtt.record_lost(4)
    return path(nic, server, rtt=rtt)


@pytest.mark.parametrize("lost", [True, False], ids=["lossy", "late"])
def test_an_interface_that_is_up_and_of_no_use_is_told_after_a_while(lost: bool) -> None:
    fleet = Fleet()
    fleet.steady(20.0)
    for _ in range(round(2 * USELESS_AFTER_S / EVERY_S) + 24):
        fleet.reports(*(fine("wlan0", server) for server in NAMES), *(useless("wwan0", s, lost=lost) for s in NAMES))
        if fleet.world.now < 120.0 + USELESS_AFTER_S:
            assert fleet.told == []
    assert fleet.told == [("wwan0", Fault.USELESS, False)]
    assert fleet.faults() == [("wwan0", Fault.USELESS)]
    (notice,) = fleet.notices
    assert ("loses" if lost else "would miss") in notice.found.text
    fleet.steady(10 * USELESS_AFTER_S)
    assert fleet.told[-1] == ("wwan0", Fault.USELESS, True)
    assert fleet.faults() == []


def test_no_interface_is_useless_where_none_does_better() -> None:
    fleet = Fleet()
    for _ in range(60):
        fleet.reports(*(useless(nic, server, lost=True) for nic in ("wlan0", "wwan0") for server in NAMES))
    assert fleet.told == []


def test_one_good_server_shows_that_it_is_not_the_interface() -> None:
    fleet = Fleet()
    for _ in range(60):
        fleet.reports(
            *(fine("wlan0", server) for server in NAMES), useless("wwan0", "a", lost=True), fine("wwan0", "b")
        )
    assert fleet.told == []


def test_what_is_known_of_a_robot_ends_with_its_run() -> None:
    fleet = Fleet()
    fleet.steady(20.0)
    for number in range(2 * FLAPS):
        fleet.reports(*(fine("wwan0", server, up=bool(number % 2)) for server in NAMES), fine("wlan0", "a"))
    assert fleet.faults()
    fleet.world.leave(fleet.robot)
    fleet.robot = fleet.world.robot()
    fleet.steady(SETTLED_S)
    assert fleet.faults() == []


def test_a_robot_that_names_ever_new_interfaces_is_watched_up_to_a_limit() -> None:
    faults = Faults()
    names = [InterfaceName(f"if{number}") for number in range(MAX_WATCHED_INTERFACES + 10)]
    faults.note_links(ROBOT, names, 0.0)
    assert faults.left_out == 10
    later = FLAP_WINDOW_S + 1.0
    for number in range(FLAPS):
        faults.note_links(ROBOT, [InterfaceName("wwan0")], later + number)
    assert faults.left_out == 10, "those that came and went long ago make room"
    (found,) = faults.look(ROBOT, {}, (), later + FLAPS)
    assert (found.found.interface, found.found.fault) == ("wwan0", Fault.FLAPPING)


def test_many_paths_over_one_interface_do_not_hide_another_one() -> None:
    fleet = Fleet()
    record = fleet.world.core.estimator
    fleet.reports(fine("wlan0", "a"), fine("wwan0", "a"))
    for number in range(2 * FLAPS):
        fleet.reports(fine("wwan0", "a", up=bool(number % 2)))
    states = record.path_states(ROBOT)
    steady, flapping = (states[InterfaceName(nic), NodeName("a")] for nic in ("wlan0", "wwan0"))
    paths = {(InterfaceName("wlan0"), NodeName(f"s{number}")): steady for number in range(MAX_PATHS_LOOKED_AT)}
    paths[InterfaceName("wwan0"), NodeName("a")] = flapping
    found = Faults().look(ROBOT, paths, (), fleet.world.now)
    assert [one.found.interface for one in found] == ["wwan0"]


def test_a_robot_is_looked_at_now_and_then() -> None:
    faults = Faults()
    faults.look(ROBOT, {}, (), 0.0)
    assert faults.look(ROBOT, {}, (), LOOK_EVERY_S) == []
    assert not faults.is_due(ROBOT, LOOK_EVERY_S + 0.1)
