from __future__ import annotations

from plr.controlplane.cli import event_text
from plr.controlplane.cli.event_text import KEPT, SHOWN
from plr.protos.model.fleet_events import DepartedSidecar, Why
from plr.protos.model.ids import NodeName, Role


def gone(why: Why, number: int = 0) -> DepartedSidecar:
    return DepartedSidecar(NodeName(f"robot-{number}"), Role.ROBOT, why, gone_s=40.0, seen_s=45.0)


def test_a_sidecar_whose_lease_expired_may_still_serve_its_peers() -> None:
    title, _, row, note = event_text.departed([gone(Why.LEASE_EXPIRED)], 0)
    assert title == "gone sidecars, newest first:"
    assert "lease_expired: not heard by the control plane for longer than its lease" in row
    assert note == f"  {KEPT}"


def test_of_one_that_went_for_another_reason_no_peer_keeps_anything() -> None:
    for why in set(Why) - {Why.LEASE_EXPIRED}:
        assert len(list(event_text.departed([gone(why)], 0))) == 3


def test_those_not_shown_are_counted() -> None:
    lines = list(event_text.departed([gone(Why.DRAINED, number) for number in range(SHOWN + 2)], 5))
    assert lines[-1] == "  and 7 more: plr events"
