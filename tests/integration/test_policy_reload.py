"""A running control plane takes another policy when told, and keeps the one it has when the file is not in order."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from plr.protos.model.ids import NodeName, ServiceName
from plr.protos.model.members import NO_POLICY, RemovalReason, RemovedPeer
from tests.support.control_plane_process import ControlPlaneProcess, cloud, robot

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


def policy(*, robots: str = "*", clouds: str = "*", offering: str = "*") -> dict[str, Any]:
    return {
        "calls": [{"robots": robots, "services": "/plan", "clouds": clouds}],
        "offers": [{"clouds": offering, "services": ["/plan"]}],
    }


@pytest.fixture
def plane(tmp_path: Path) -> Iterator[ControlPlaneProcess]:
    with ControlPlaneProcess(tmp_path, warm_up_ms=0, policy=policy(clouds="cloud-a")) as running:
        yield running


def test_the_policy_is_in_force_from_the_start_and_changes_when_told(plane: ControlPlaneProcess) -> None:
    plane.wait_for_line("policy in force: rules for calls 1, for offers 1")
    with cloud(plane.address, "cloud-a") as a, cloud(plane.address, "cloud-b") as b, robot(plane.address) as r:
        first = r.peers("cloud-a")
        r.mapping("cloud-a", "cloud-a")
        permit = a.peers("robot").peers[0].may_call
        assert permit.services == {ServiceName("/plan")}
        assert not permit.everything
        assert b.peers().policy == first.policy != NO_POLICY
        plane.reload(policy=policy())
        second = r.peers("cloud-a", "cloud-b")
        assert second.policy not in (first.policy, NO_POLICY)
        r.mapping("cloud-a", "cloud-b")
        b.peers("robot")
        plane.reload(policy=policy(clouds="cloud-b"))
        assert RemovedPeer(NodeName("cloud-a"), RemovalReason.FORBIDDEN) in r.peers("cloud-b").removed
        r.mapping("cloud-b", "cloud-b")
        plane.reload(policy=None)
        nothing = r.peers()
        assert nothing.policy not in (NO_POLICY, second.policy), "a policy that is empty is one that denies"


def test_a_file_that_is_not_in_order_leaves_the_policy_in_force(plane: ControlPlaneProcess) -> None:
    with cloud(plane.address, "cloud-a"), robot(plane.address) as r:
        told = r.peers("cloud-a").version
        plane.reload(policy=policy(clouds="no such name"))
        plane.wait_for_line("policy.calls[0].clouds[0]: matches no name", "the policy in force stays")
        assert plane.status()["robot"].peers.version_sent == told
        plane.reload(policy=policy(clouds="cloud-a"), lease_ms=50_000)
        plane.wait_for_line("lease_ms changed too, which needs a restart")
        plane.wait_for_line("the policy is the same as before")


def test_refused_offers_are_logged_once_and_shown(plane: ControlPlaneProcess) -> None:
    before = len(plane.lines)
    plane.reload(policy=policy(offering="cloud-a"))
    plane.wait_for_line("policy in force", after=before)
    with cloud(plane.address, "cloud-a"), cloud(plane.address, "cloud-b") as b, robot(plane.address) as r:
        r.peers("cloud-a")
        plane.wait_for_line(
            "cloud-b offers /plan, which the policy does not allow",
            'missing under offers: {clouds: ["cloud-b"], services: ["/plan"]}',
        )
        b.peers()
        shown = {name: found.refused_offers for name, found in plane.status().items()}
        assert shown == {"cloud-a": (), "cloud-b": ("/plan",), "robot": ()}
    assert sum("cloud-b offers" in line for line in plane.lines) == 1


def test_without_a_policy_the_log_says_so(tmp_path: Path) -> None:
    with ControlPlaneProcess(tmp_path) as running:
        running.wait_for_line("WARNING", "there is no policy: every robot may call")
        with cloud(running.address, "cloud-a") as a, robot(running.address) as r:
            assert r.peers("cloud-a").policy == NO_POLICY
            assert a.peers("robot").peers[0].may_call.everything
