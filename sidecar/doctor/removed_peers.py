"""Says why the control plane removed peers: then nobody looks for the fault on their hosts or in the network. Pure."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Any

from plr.protos.model.members import RemovalReason
from plr.sidecar.core.engine.removals import WHY_REMOVED
from plr.sidecar.doctor.finding import duration, ok, warn

if TYPE_CHECKING:
    from collections.abc import Iterator

    from plr.sidecar.doctor.finding import Finding

State = dict[str, Any]

MAX_SHOWN = 8
"""Lines about removed peers."""
REMEDIES = {
    RemovalReason.REVOKED: "if that is wrong, issue another certificate to it: docs/start/certificates.md",
    RemovalReason.EXPIRED: "renew its certificate: docs/start/certificates.md",
    RemovalReason.FORBIDDEN: "if the two need each other, correct the policy: docs/use/access-control.md",
}


def findings(state: State) -> Iterator[Finding]:
    """Report the peers that the control plane removed, the last one first."""
    removed = state.get("removed_peers") or ()
    for one in removed[:MAX_SHOWN]:
        yield _finding(one["name"], one.get("reason"), duration(one["since_s"]), one.get("kept"))
    if len(removed) > MAX_SHOWN:
        yield ok("peer", f"{len(removed) - MAX_SHOWN} more were removed by the control plane within the last hour")


def _finding(name: str, told: str | None, since: str, kept: str | None) -> Finding:
    reason = None
    with suppress(ValueError):
        reason = RemovalReason(told)
    why = WHY_REMOVED[reason] if reason else told or "it does not list it any more"
    text = f"{name}: removed by the control plane {since} ago: {why}"
    if reason is RemovalReason.LEFT:
        return ok("peer", text)
    if kept == "path":
        text += "; its paths work and stay in use"
        return warn("peer", text, f"find out why {name} does not reach its control plane: plr doctor on that host")
    if kept == "dormant":
        text += "; no path to it is up since, and it is a peer again when it talks"
    remedy = f"plr status shows since when; on the host of {name}: plr doctor, if it runs"
    return warn("peer", text, REMEDIES.get(reason, remedy) if reason else remedy)


def without(state: State) -> State:
    """Return the state without the ended paths of removed peers, about which `findings` says more."""
    names = {one["name"] for one in state.get("removed_peers") or ()}
    return {**state, "gone": [one for one in state.get("gone") or () if one["peer"] not in names]}
