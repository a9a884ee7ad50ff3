from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from plr.protos.model.ids import ServiceName
from plr.protos.model.members import Peer, ServiceOffer
from plr.sidecar.core.base.values import PathState
from plr.sidecar.core.robot.request import service_catalog
from plr.sidecar.core.robot.request.service_catalog import MAX_OFFERED_SERVICES, WITHDRAW_AFTER_S, Offers
from plr.sidecar.core.rules.service_rule import Rules
from plr.sidecar.core.seam.application import OfferService, WithdrawService
from plr.sidecar.core.seam.stats import EngineStats
from plr.sidecar.core.transfer.routes import Routes
from tests.support.builders import ECHO, TYPE, A, B, path, peer, rule

if TYPE_CHECKING:
    from collections.abc import Sequence

OTHER_TYPE = (ServiceOffer(ECHO, "t/srv/Other"),)


class Robot:
    """Offers over routes that the test sets."""

    def __init__(self, *peers: Peer, pattern: str = ECHO, lifetime_s: float = 10.0, kind: str = "") -> None:
        self.routes = Routes()
        self.stats = EngineStats()
        self.offers = Offers(Rules((replace(rule(pattern, lifetime_s=lifetime_s), type=kind),)), self.stats)
        for known in (A, B):
            self.reach(known)
        self.set_peers(peers)

    def set_peers(self, peers: Sequence[Peer]) -> None:
        for known in peers:
            self.offers.set_peer(known)
        for gone in self.offers.others({known.name for known in peers}):
            self.offers.forget_peer(gone)

    def reach(self, name: str, state: PathState = PathState.UP) -> None:
        self.routes.set_state(path(peer=name), state)

    def update(self, now: float = 1.0) -> list[OfferService | WithdrawService]:
        return self.offers.update(self.routes, now)


def test_a_service_is_offered_with_its_first_reachable_server_and_once() -> None:
    robot = Robot(peer(A), peer(B, session=2))
    assert robot.update() == [OfferService(ECHO, TYPE)]
    assert robot.update() == []
    assert robot.offers.servers(ECHO) == (A, B)
    assert robot.offers.offered == {ECHO: TYPE}


def test_an_unreachable_server_offers_nothing_yet() -> None:
    robot = Robot(peer(A))
    robot.reach(A, PathState.DOWN)
    assert robot.update() == []
    robot.reach(A, PathState.UNSTABLE)
    assert robot.update() == [OfferService(ECHO, TYPE)]


def test_what_servers_offer_of_which_none_is_reached_is_told_with_their_number() -> None:
    robot = Robot(peer(A), peer(B, session=2))
    robot.reach(A, PathState.DOWN)
    robot.reach(B, PathState.DOWN)
    robot.update()
    assert robot.offers.unreached == {ECHO: 2}
    robot.reach(B)
    robot.update()
    assert robot.offers.unreached == {}
    robot.reach(B, PathState.DOWN)
    robot.update(10.0)
    assert robot.offers.unreached == {}, "it is still offered"
    robot.update(10.0 + WITHDRAW_AFTER_S)
    robot.update(11.0 + 2 * WITHDRAW_AFTER_S)
    assert robot.offers.unreached == {ECHO: 2}
    robot.set_peers([])
    assert robot.offers.unreached == {}


def test_servers_of_another_type_than_is_wanted_are_none_to_be_reached() -> None:
    robot = Robot(peer(A), kind="other_interfaces/srv/Other")
    robot.reach(A, PathState.DOWN)
    robot.update()
    assert robot.offers.unreached == {}


def test_services_without_a_rule_are_not_carried() -> None:
    robot = Robot(peer(A, offers=(ServiceOffer(ServiceName("/secret"), TYPE),)))
    assert robot.update() == []
    assert robot.offers.servers(ServiceName("/secret")) == ()


def test_darkness_is_outlasted_for_a_while_then_ends_the_offer() -> None:
    robot = Robot(peer(A))
    robot.update()
    assert robot.offers.next_timer() is None
    robot.reach(A, PathState.DOWN)
    assert robot.update(10.0) == []
    assert robot.offers.next_timer() == 10.0 + WITHDRAW_AFTER_S
    assert robot.update(10.0 + WITHDRAW_AFTER_S - 0.1) == []
    (withdrawn,) = robot.update(10.0 + WITHDRAW_AFTER_S)
    assert isinstance(withdrawn, WithdrawService)
    assert robot.offers.next_timer() is None, "a timer that nothing clears would spin"
    robot.reach(A)
    assert robot.update(99.0) == [OfferService(ECHO, TYPE)]


def test_an_offer_outlasts_what_waited_when_darkness_fell() -> None:
    robot = Robot(peer(A), lifetime_s=40.0)
    robot.update()
    robot.reach(A, PathState.DOWN)
    assert robot.update(10.0) == []
    assert robot.offers.next_timer() == 50.0
    assert robot.update(49.9) == []
    assert robot.update(50.0) == [WithdrawService(ECHO, "no path to a server for 40 s")]


def test_light_in_between_starts_the_wait_again() -> None:
    robot = Robot(peer(A))
    robot.update()
    for now, state in (
        (10.0, PathState.DOWN),
        (20.0, PathState.UP),
        (24.0, PathState.DOWN),
        (30.0, PathState.DOWN),
    ):
        robot.reach(A, state)
        assert robot.update(now) == []
    assert robot.offers.next_timer() == 24.0 + WITHDRAW_AFTER_S


def test_servers_that_leave_may_come_back_for_a_while() -> None:
    robot = Robot(peer(A))
    robot.update()
    robot.set_peers([])
    assert robot.update(2.0) == []
    assert robot.offers.offered == {ECHO: TYPE}
    robot.set_peers([peer(B, session=2)])
    assert robot.update(10.0) == []
    assert robot.offers.next_timer() is None
    robot.set_peers([])
    assert robot.update(20.0) == []
    assert robot.offers.next_timer() == 20.0 + WITHDRAW_AFTER_S
    assert robot.update(20.0 + WITHDRAW_AFTER_S) == [WithdrawService(ECHO, "no live server for 15 s")]
    assert robot.offers.next_timer() is None


def test_a_draining_server_gets_requests_only_where_there_is_no_other() -> None:
    assert Robot(peer(A, draining=True), peer(B, session=2)).offers.servers(ECHO) == (B,)
    assert Robot(peer(A, draining=True)).offers.servers(ECHO) == (A,)


def test_the_type_of_most_servers_wins_and_the_odd_one_is_named() -> None:
    robot = Robot(peer(A), peer(B, session=2), peer("odd", session=3, offers=OTHER_TYPE))
    assert robot.update() == [OfferService(ECHO, TYPE)]
    assert robot.offers.servers(ECHO) == (A, B)
    assert robot.offers.conflicts == {(ECHO, "odd", "t/srv/Other")}
    robot.set_peers([peer(A)])
    assert robot.offers.conflicts == set(), "settled conflicts are forgotten"


def test_in_a_tie_the_type_already_offered_stays() -> None:
    for first, second in (
        (ServiceOffer(ECHO, "a"), ServiceOffer(ECHO, "b")),
        (ServiceOffer(ECHO, "b"), ServiceOffer(ECHO, "a")),
    ):
        robot = Robot(peer(A, offers=(first,)))
        robot.update()
        robot.set_peers([peer(A, offers=(first,)), peer(B, session=2, offers=(second,))])
        assert robot.update() == []
        assert robot.offers.servers(ECHO) == (A,)


@pytest.mark.audit("ops-16")
def test_after_a_restart_the_type_of_the_run_before_wins_a_tie_whoever_comes_first() -> None:
    """A rogue server that offers the service with another type may have a path before the real one."""
    rogue, real = peer(A, offers=(ServiceOffer(ECHO, "a/srv/A"),)), peer(B, session=2)
    robot = Robot(rogue, real)
    robot.offers.remember_type(ECHO, TYPE)
    assert robot.update() == [OfferService(ECHO, TYPE)]
    assert robot.offers.servers(ECHO) == (B,)
    for known in (A, B):
        robot.reach(known, PathState.DOWN)
    robot.update(10.0)
    robot.update(10.0 + WITHDRAW_AFTER_S)
    assert robot.offers.offered == {}
    for known in (A, B):
        robot.reach(known)
    assert robot.update(99.0) == [OfferService(ECHO, TYPE)], "nor after all was dark"


@pytest.mark.audit("ops-16")
def test_the_type_of_the_configuration_stands_against_any_number_of_servers() -> None:
    robot = Robot(peer(A, offers=OTHER_TYPE), peer(B, session=2, offers=OTHER_TYPE), kind=TYPE)
    assert robot.update() == []
    assert robot.offers.servers(ECHO) == ()
    assert robot.offers.conflicts == {(ECHO, A, "t/srv/Other"), (ECHO, B, "t/srv/Other")}
    robot.set_peers([peer(A, offers=OTHER_TYPE), peer(B, session=2)])
    assert robot.update() == [OfferService(ECHO, TYPE)]
    assert robot.offers.servers(ECHO) == (B,)


def test_types_of_names_that_peers_invent_are_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(service_catalog, "MAX_TYPES", 2)
    robot = Robot(pattern="/*")
    names = [ServiceName(f"/s{number}") for number in range(3)]
    for name in names:
        robot.offers.remember_type(name, TYPE)
    assert [robot.offers.knows_type(name) for name in names] == [False, True, True]
    assert robot.stats.dropped["type_forgotten"] == 1


def test_when_the_type_changes_the_old_offer_goes_and_the_new_one_comes() -> None:
    robot = Robot(peer(A))
    robot.update()
    robot.set_peers([peer(A, offers=OTHER_TYPE)])
    assert robot.update() == [
        WithdrawService(ECHO, "its servers offer it as t/srv/Other now"),
        OfferService(ECHO, "t/srv/Other"),
    ]


def test_a_service_gains_each_new_server_once() -> None:
    robot = Robot(peer(A))
    assert robot.offers.take_gained() == {ECHO}
    robot.set_peers([peer(A)])
    assert robot.offers.take_gained() == set()
    robot.set_peers([peer(A), peer(B, session=2)])
    assert robot.offers.take_gained() == {ECHO}
    robot.set_peers([peer(B, session=2)])
    assert robot.offers.take_gained() == set()
    robot.set_peers([peer(A, draining=True)])
    assert robot.offers.take_gained() == {ECHO}
    robot.set_peers([peer(B, session=2)])
    robot.set_peers([])
    assert robot.offers.take_gained() == set(), "a service that nobody offers any more has not gained"


@pytest.mark.audit("sec-5")
def test_a_cloud_that_offers_everything_leaves_room_for_what_others_offer() -> None:
    many = tuple(ServiceOffer(ServiceName(f"/made_up_{number}"), TYPE) for number in range(2 * MAX_OFFERED_SERVICES))
    robot = Robot(peer(A, offers=many), pattern="/*")
    assert len(robot.update()) == MAX_OFFERED_SERVICES // 2
    assert robot.stats.dropped["too_many_offers"] == len(many) - MAX_OFFERED_SERVICES // 2
    robot.set_peers([peer(A, offers=many), peer(B, session=2)])
    assert robot.update() == [OfferService(ECHO, TYPE)]
    assert robot.stats.dropped["too_many_offers"] == len(many) - MAX_OFFERED_SERVICES // 2, "each is counted once"
    assert robot.update() == []


@pytest.mark.audit("sec-5")
def test_what_found_no_room_is_offered_when_there_is_some() -> None:
    many = tuple(ServiceOffer(ServiceName(f"/s{number}"), TYPE) for number in range(MAX_OFFERED_SERVICES))
    robot = Robot(peer(A, offers=many), pattern="/*")
    assert len(robot.update()) == MAX_OFFERED_SERVICES // 2
    others = tuple(offer for offer in many if offer.name not in robot.offers.offered)
    robot.set_peers([peer(A, offers=others)])
    robot.update(10.0)
    events = robot.update(10.0 + WITHDRAW_AFTER_S)
    assert sum(isinstance(event, WithdrawService) for event in events) == MAX_OFFERED_SERVICES // 2
    assert sum(isinstance(event, OfferService) for event in events) == MAX_OFFERED_SERVICES // 2
    assert set(robot.offers.offered) == {offer.name for offer in others}
