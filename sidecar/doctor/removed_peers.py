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
MAX_NAMED = 3
"""Dormant peers named in one line."""
LISTED_AT_MOST = 64
"""Removed peers that an earlier sidecar lists without their number."""
REMEDIES = {
    RemovalReason.REVOKED: "if that is wrong, issue another certificate to it: docs/start/certificates.md",
    RemovalReason.EXPIRED: "renew its certificate: docs/start/certificates.md",
    RemovalReason.FORBIDDEN: "if the two need each other, correct the policy: docs/use/access-control.md",
}
SEE = "docs/operate/troubleshooting.md, A peer that only the control plane lost"


def findings(state: State) -> Iterator[Finding]:
    """Report the peers that the control plane removed, the last one first."""
    removed = _removed(state)
    for one in removed[:MAX_SHOWN]:
        yield _finding(one, _reached(state, one["name"]))
    yield from (ok("peer", text) for text in _more(state, removed))


def _removed(state: State) -> list[dict[str, Any]]:
    return list(state.get("removed_peers") or ())


def _reached(state: State, name: str) -> bool | None:
    """Return whether a path to the peer is not down; None if no path to it is reported."""
    states = [path["state"] for path in state.get("paths") or () if path["peer"] == name]
    return any(one != "down" for one in states) if states else None


def _finding(one: dict[str, Any], reached: bool | None) -> Finding:
    name, kept = one["name"], one.get("kept")
    reason = None
    with suppress(ValueError):
        reason = RemovalReason(one.get("reason"))
    text = f"{name}: removed by the control plane {_since_and_why(one)}"
    if reason is RemovalReason.LEFT:
        return ok("peer", text)
    if kept == "path" and reached is not False:
        text += "; its paths work and stay in use"
        return warn("peer", text, f"find out why {name} does not reach its control plane: plr doctor on that host")
    if kept == "path":
        text += "; it is kept, but no path to it is up now"
    elif kept == "dormant" and one.get("heard"):
        text += f"; it is kept{_dark(one)}: it is heard here, but does not hear the answers"
        remedy = f"find what drops what this host sends to {name}: a firewall, or its carrier; {SEE}"
        return warn("peer", text, remedy)
    elif kept == "dormant":
        text += f"; it is kept{_dark(one)}, and is a peer again as soon as a path answers"
    on_host = f"on the host of {name}: plr doctor, if it runs"
    # A control plane that restarted knows nothing of it.
    remedy = on_host if one.get("reason") is None else f"plr status shows since when; {on_host}"
    return warn("peer", text, REMEDIES.get(reason, remedy) if reason else remedy)


def _since_and_why(one: dict[str, Any]) -> str:
    told = one.get("reason")
    with suppress(ValueError):
        told = WHY_REMOVED[RemovalReason(told)]
    return f"{duration(one['since_s'])} ago: {told or 'it does not list it any more'}"


def _dark(one: dict[str, Any]) -> str:
    dormant_s = one.get("dormant_s")
    if dormant_s is None:  # an earlier version does not report it
        return ", no path to it is up now"
    return f", no path to it has been up for {duration(dormant_s)}"


def _more(state: State, removed: list[dict[str, Any]]) -> Iterator[str]:
    """Yield what is to be said of the removed peers without a line of their own."""
    counts = state.get("removed_counts")
    if counts is None:  # an earlier version reports only the list
        if len(removed) > MAX_SHOWN:
            least = "at least " if len(removed) >= LISTED_AT_MOST else ""
            yield f"{least}{len(removed) - MAX_SHOWN} more were removed by the control plane"
        return
    shown = [one.get("kept") for one in removed[:MAX_SHOWN]]
    left = {kept: counts.get(kept or "forgotten", 0) - shown.count(kept) for kept in ("path", "dormant", None)}
    if left["path"] > 0:
        yield f"{left['path']} more are kept that the control plane removed: their paths stay in use"
    if left["dormant"] > 0:
        yield (
            f"{left['dormant']} more are kept that the control plane removed, without a path that is up: each is a "
            "peer again as soon as a path answers"
        )
    if left[None] > 0:
        least = "at least " if counts.get("at_least") else ""
        yield f"{least}{left[None]} more were removed by the control plane within the last hour"


def dormant(state: State) -> str:
    """Return which dormant peers are kept, why and since when, for one line; empty if there are none."""
    ones = [one for one in _removed(state) if one.get("kept") == "dormant"]
    number = max(len(ones), (state.get("removed_counts") or {}).get("dormant", 0))
    shown = [f"{one['name']} (removed {_since_and_why(one)}{_dark(one)})" for one in ones[:MAX_NAMED]]
    if number > len(shown):
        shown.append(f"{number - len(shown)} more" if shown else f"{number} peers")
    return ", ".join(shown)


def without(state: State) -> State:
    """Return the state without the ended paths of removed peers, about which `findings` says more."""
    names = {one["name"] for one in _removed(state)}
    return {**state, "gone": [one for one in state.get("gone") or () if one["peer"] not in names]}
