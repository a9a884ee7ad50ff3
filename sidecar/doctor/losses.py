"""Finds what to blame for lost datagrams: an interface, a peer, all of this host, or one path. Pure."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from plr.sidecar.doctor.finding import duration, share, warn

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from plr.sidecar.doctor.finding import Finding

LOSSY = 0.05
"""Loss rate of datagrams above which a path gets a warning."""
MIN_SENT, MIN_LOST = 20, 5
"""Fewest datagrams sent and lost that say anything about the loss rate."""
MOST = 0.5
"""An interface or a peer is blamed if more than this share of its paths loses."""
SEE = "docs/operate/doctor.md, Lost datagrams"

Path = dict[str, Any]


def told(path: Mapping[str, Any]) -> str:
    """Return how much of what a path sent got lost, and in what time."""
    recent = path.get("recent")
    if recent is None:  # an earlier version tells only the sum of the path's whole life
        return f"{share(path['lost'] / path['sent'] if path['sent'] else 0.0)} lost since the path is known"
    window = duration(recent["window_s"])
    if not recent["sent"]:
        return f"nothing sent in the last {window}"
    return f"{share(recent['lost'] / recent['sent'])} of {recent['sent']} datagrams lost in the last {window}"


def _counts(path: Mapping[str, Any]) -> tuple[int, int]:
    recent = path.get("recent") or path
    return recent["sent"], recent["lost"]


def is_judged(path: Mapping[str, Any]) -> bool:
    """Return whether enough was sent to know the loss rate."""
    return bool(path["state"] != "down" and _counts(path)[0] >= MIN_SENT)


def is_lossy(path: Mapping[str, Any]) -> bool:
    """Return whether a path that is not down loses so much that it gets a warning."""
    sent, lost = _counts(path)
    return is_judged(path) and lost >= MIN_LOST and lost > LOSSY * sent


@dataclass(slots=True)
class Blame:
    """The common causes of losses, and the paths that they explain."""

    findings: list[Finding] = field(default_factory=list)
    explained: dict[int, str] = field(default_factory=dict)
    """By the path's place in the list: what is blamed."""


def blame(paths: Sequence[Path]) -> Blame:
    """Blame the peer where several ways to it lose, and the interface where it loses to several peers.

    What explains most comes first, and what it explains counts for nothing else. If nearly all of several interfaces
    and several peers lose, neither is blamed, but this host.
    """
    found = Blame()
    judged = [number for number, path in enumerate(paths) if is_judged(path)]
    lossy = [number for number in judged if is_lossy(paths[number])]
    interfaces = {paths[number]["interface"] for number in lossy}
    peers = {paths[number]["peer"] for number in lossy}
    if len(interfaces) > 1 and len(peers) > 1 and len(lossy) == len(judged):
        _explain(
            found,
            paths,
            lossy,
            f"this host: all paths lose, over {_listed(interfaces)} to {_listed(peers)}",
            f"look for what they share: a busy host, a common modem or uplink; {SEE}",
        )
        return found
    left = set(lossy)
    while (candidate := _best(paths, judged, left)) is not None:
        kind, name = candidate
        mine = sorted(number for number in left if paths[number][kind] == name)
        if kind == "interface":
            others = _listed({paths[number]["peer"] for number in mine})
            text, remedy = f"{name}: loses to {others}", f"check the carrier of {name}: signal, queue; {SEE}"
        else:
            others = _listed({paths[number]["interface"] for number in mine})
            text = f"{name}: datagrams to it get lost over {others}"
            remedy = f"check the host of {name} and its link, not the interfaces here; {SEE}"
        _explain(found, paths, mine, text, remedy)
        left.difference_update(mine)
    return found


def _best(paths: Sequence[Path], judged: Sequence[int], left: set[int]) -> tuple[str, str] | None:
    """Return the interface or peer that explains most of the paths in `left`; None if none explains two."""
    judged_of: Counter[tuple[str, str]] = Counter()
    lossy_of: Counter[tuple[str, str]] = Counter()
    ends: dict[tuple[str, str], set[str]] = {}
    for number in judged:
        path = paths[number]
        for kind, other in (("interface", "peer"), ("peer", "interface")):
            key = kind, path[kind]
            judged_of[key] += 1
            if number in left:
                lossy_of[key] += 1
                ends.setdefault(key, set()).add(path[other])
    candidates = [key for key, count in lossy_of.items() if len(ends[key]) > 1 and count > MOST * judged_of[key]]
    return max(candidates, key=lambda key: (lossy_of[key], key), default=None)


def _explain(found: Blame, paths: Sequence[Path], mine: Sequence[int], text: str, remedy: str) -> None:
    counts = [_counts(paths[number]) for number in mine]
    rates = [lost / sent for sent, lost in counts]
    windows = [paths[number]["recent"]["window_s"] for number in mine if paths[number].get("recent")]
    when = f" in the last {duration(max(windows))}" if windows else " since these paths are known"
    found.findings.append(warn("path", f"{text}: {share(min(rates))} to {share(max(rates))} lost{when}", remedy))
    what = text.partition(":")[0]
    found.explained.update(dict.fromkeys(mine, what))


def _listed(names: set[str], most: int = 4) -> str:
    shown = sorted(names)
    more = f" and {len(shown) - most} more" if len(shown) > most else ""
    return ", ".join(shown[:most]) + more
