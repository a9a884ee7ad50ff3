"""What the operator reads."""

from __future__ import annotations

import difflib
from dataclasses import replace

import pytest

from plr.controlplane.cli import status_table
from plr.controlplane.cli.status_table import MAX_HINTED, MAX_LINE_CHARACTERS, MAX_LINES_OF_SIDECAR, render
from plr.protos.model.ids import InterfaceName, NodeName, Role, ServiceName, SessionId, Version
from plr.protos.model.mapping import Assignment, ServiceMapping
from plr.protos.model.members import HeldList, Peer, RevocationSet, ServiceOffer
from plr.protos.model.report import PathReport
from plr.protos.model.status import ResourceStatus, SidecarStatus, SyncState
from tests.support.samples import PLAN, histogram, offer, use

SYNCED = ResourceStatus(Version(7), Version(7), SyncState.SYNCED)


def test_nobody_is_said_so() -> None:
    assert render([]) == "no sidecars"


def test_a_robot_and_a_cloud() -> None:
    wlan, a = InterfaceName("wlan0"), NodeName("cloud-a")
    cloud = SidecarStatus(
        Peer(a, Role.CLOUD, SessionId(1), b"", 1, offers=(offer(),), draining=True), True, 4.0, "0.1.0", peers=SYNCED
    )
    robot = SidecarStatus(
        Peer(NodeName("robot"), Role.ROBOT, SessionId(2), b"", 1),
        connected=False,
        lease_left_s=1.25,
        software_version="",
        uses=(use(),),
        peers=SYNCED,
        mapping=ResourceStatus(Version(9), Version(8), SyncState.REJECTED, "no interface 'wwan0' here"),
        services=(ServiceMapping(PLAN, (Assignment(wlan, a),), 0.0125, "least sum"),),
        paths=(
            PathReport(wlan, a, True, histogram(0.02, times=9), 90, 1),
            PathReport(InterfaceName("wwan0"), a, False, histogram()),
        ),
    )
    text = render([cloud, robot])
    assert [line.split() for line in text.splitlines()[:3]] == [
        ["NAME", "ROLE", "STREAM", "LEASE", "PEERS", "MAPPING", "SERVICES", "SOFTWARE"],
        ["cloud-a", "cloud", "leaving", "4.0", "s", "synced", "-", "/plan", "0.1.0"],
        ["robot", "robot", "lost", "1.2", "s", "synced", "rejected", "/plan", "-"],
    ]
    assert "mapping REJECTED version 9, keeps 8: no interface 'wwan0' here" in text
    assert "/plan: wlan0 -> cloud-a (predicted miss 0.0125; least sum)" in text
    assert "wlan0 -> cloud-a  up    rtt 20." in text
    assert "wwan0 -> cloud-a  DOWN  rtt -" in text


def test_a_mapping_to_nowhere_is_said_so() -> None:
    robot = SidecarStatus(
        Peer(NodeName("robot"), Role.ROBOT, SessionId(2), b"", 1),
        True,
        1.0,
        "",
        services=(ServiceMapping(PLAN, (), 1.0, "no live server"),),
    )
    assert "/plan: no mapping (no live server); no path is up\n" in render([robot]) + "\n"


def test_without_a_mapping_the_paths_that_are_up_are_told_and_no_miss_is_predicted() -> None:
    wlan, wwan = InterfaceName("wlan0"), InterfaceName("wwan0")
    robot = SidecarStatus(
        Peer(NodeName("robot"), Role.ROBOT, SessionId(2), b"", 1),
        True,
        1.0,
        "",
        services=(ServiceMapping(PLAN, (), 1.0, "no plan yet"),),
        paths=tuple(PathReport(name, NodeName("cloud-a"), name is wlan, histogram()) for name in (wlan, wwan)),
    )
    text = render([robot])
    assert "/plan: no mapping (no plan yet); if the robot knows a server of it, requests go over what is up: " in text
    assert "what is up: wlan0 -> cloud-a\n" in text
    assert "predicted" not in text


def test_fallbacks_are_shown_where_there_are_any() -> None:
    peer = Peer(NodeName("robot"), Role.ROBOT, SessionId(2), b"", 1)
    for fallback_up, told in (
        (None, ""),
        (True, "/plan: fallback ready on the robot"),
        (False, "/plan: fallback MISSING"),
    ):
        text = render([SidecarStatus(peer, True, 1.0, "", uses=(replace(use(), fallback_up=fallback_up),))])
        assert told in text
        assert ("fallback" in text) == bool(told)


def test_refused_offers_are_shown() -> None:
    peer = Peer(NodeName("cloud-a"), Role.CLOUD, SessionId(2), b"", 1, offers=(offer(), offer("/secret")))
    cloud = SidecarStatus(peer, True, 1.0, "", refused_offers=(ServiceName("/secret"),))
    assert "REFUSED by the policy: /secret (offered here, announced to no robot)" in render([cloud])


def test_who_lacks_a_revocation_is_seen() -> None:
    peer = Peer(NodeName("robot"), Role.ROBOT, SessionId(1), b"", 1)
    held = RevocationSet((HeldList(5, 11, 1000),), too_old=1)
    status = SidecarStatus(peer, True, 1.0, "", revocations=held)
    text = render([status], RevocationSet((HeldList(5, 12, 87_400),)), 87_400.0 + 8640.0)
    assert text.splitlines()[0] == "control plane: revocation list 12, signed 0.1 days ago"
    assert "revocation list 11, signed 1.1 days ago: OLDER than the control plane's 12" in text
    assert "REVOCATION LIST TOO OLD of 1 CAs: it talks to none of their nodes; do: plr ca publish" in text
    assert "signed 1000 s FROM NOW: a clock is wrong" in render([status], now_wall=0.0)


@pytest.mark.audit("ops-12")
def test_what_one_member_claims_of_revocation_lists_is_shown_for_that_member_alone() -> None:
    def holds(name: str, number: int, ca: int = 5) -> SidecarStatus:
        peer = Peer(NodeName(name), Role.ROBOT, SessionId(1), b"", 1)
        return SidecarStatus(peer, True, 1.0, "", revocations=RevocationSet((HeldList(ca, number, 1000),)))

    own = RevocationSet((HeldList(5, 12, 1000),))
    claims = [holds("evil", 2**64 - 1), holds("strange", 1, ca=6)]
    text = render([holds("honest", 12), *claims], own, 1000.0)
    assert "OLDER" not in text
    assert text.count("which the control plane does not have") == 2
    told = text.split("\n\n")
    assert told[1] == "honest:\n  revocation list 12, signed 0.0 days ago"
    assert told[2].startswith(f"evil:\n  claims revocation list {2**64 - 1}, which the control plane does not have")


@pytest.mark.audit("ops-12")
def test_what_one_says_of_itself_takes_no_room_of_the_others() -> None:
    offers = tuple(offer(f"/s{number:04}{'x' * 249}") for number in range(1024))
    names = tuple(one.name for one in offers)
    loud = Peer(NodeName("loud"), Role.CLOUD, SessionId(1), b"", 1, offers=offers)
    quiet = Peer(NodeName("quiet"), Role.CLOUD, SessionId(2), b"", 1, offers=(offer(), offer("/other")))
    text = render(
        [
            SidecarStatus(loud, True, 1.0, "1", refused_offers=names, withdrawn=names),
            SidecarStatus(quiet, True, 1.0, "1"),
        ]
    )
    rows = {line.split()[0]: line for line in text.splitlines() if line}
    assert len(rows["quiet"]) < 150
    assert rows["quiet"].split()[-2:] == [f"{PLAN},/other", "1"]
    assert "and 1023 more" in rows["loud"]
    assert max(map(len, text.splitlines())) < 2 + MAX_LINE_CHARACTERS + 1
    assert len(text.splitlines()) < MAX_LINES_OF_SIDECAR + 10
    assert text.splitlines()[-1] == "  and 769 more: plr status loud --json"


@pytest.mark.audit("ops-12")
def test_what_a_robot_says_that_it_offers_is_no_hint() -> None:
    robot = Peer(NodeName("robot"), Role.ROBOT, SessionId(1), b"", 1, offers=(offer("/plan_paths"),))
    other = Peer(NodeName("other"), Role.ROBOT, SessionId(2), b"", 1)
    statuses = [
        SidecarStatus(robot, True, 1.0, ""),
        SidecarStatus(other, True, 1.0, "", unmet=(ServiceName("/plan_path"),)),
    ]
    assert "did you mean" not in render(statuses)


@pytest.mark.audit("ops-12")
def test_what_is_wrong_is_not_cut_off() -> None:
    robot = Peer(NodeName("robot"), Role.ROBOT, SessionId(1), b"", 1)
    mappings = tuple(
        ServiceMapping(ServiceName(f"/s{number}"), (Assignment(InterfaceName("wlan0"), NodeName("EDGE-1")),), 0.1, "")
        for number in range(2 * MAX_LINES_OF_SIDECAR)
    )
    nowhere = ServiceMapping(ServiceName("/last"), (), 1.0, "")
    down = (InterfaceName("wwan0"),)
    text = render([SidecarStatus(robot, True, 1.0, "", services=(*mappings, nowhere), unmet=(PLAN,), down=down)])
    assert f"UNMET {PLAN}" in text
    assert "wwan0 DOWN" in text
    assert "/s0: wlan0 -> EDGE-1" in text
    assert "/last: no mapping" in text


@pytest.mark.audit("ops-5")
def test_many_that_miss_one_service_cost_one_search(monkeypatch: pytest.MonkeyPatch) -> None:
    searched: list[str] = []
    close_matches = difflib.get_close_matches

    def search(name: str, among: list[str], n: int) -> list[str]:
        searched.append(name)
        return close_matches(name, among, n)

    monkeypatch.setattr(difflib, "get_close_matches", search)
    cloud = Peer(
        NodeName("cloud"), Role.CLOUD, SessionId(1), b"", 1, offers=(ServiceOffer(PLAN, "nav_msgs/srv/GetPlan"),)
    )
    wanted = ServiceName(PLAN + "_")
    robots = [Peer(NodeName(f"robot-{number}"), Role.ROBOT, SessionId(2), b"", 1) for number in range(50)]
    text = render(
        [SidecarStatus(cloud, True, 1.0, ""), *(SidecarStatus(r, True, 1.0, "", unmet=(wanted,)) for r in robots)]
    )
    assert text.count(f"did you mean {PLAN}?") == 50
    assert searched == [wanted]


@pytest.mark.audit("ops-5")
def test_long_names_keep_no_operator_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(status_table, "MAX_COMPARED", 10_000)
    names = [ServiceName(f"/{'x' * 60}{number}") for number in range(64)]
    long = ServiceName(f"/{'y' * MAX_HINTED}")
    offers = tuple(ServiceOffer(name, "nav_msgs/srv/GetPlan") for name in (*names[:2], long))
    cloud = Peer(NodeName("cloud"), Role.CLOUD, SessionId(1), b"", 1, offers=offers)
    robot = Peer(NodeName("robot"), Role.ROBOT, SessionId(2), b"", 1)
    unmet = (ServiceName(long + "y"), *(ServiceName(name + "_") for name in names))
    text = render([SidecarStatus(cloud, True, 1.0, ""), SidecarStatus(robot, True, 1.0, "", unmet=unmet)])
    assert text.count("UNMET") == len(unmet)
    assert text.count("did you mean") == 1
