"""Formats the status of all sidecars as text for a terminal."""

from __future__ import annotations

import difflib
import math
from typing import TYPE_CHECKING

from plr.controlplane.cli.text_table import columns, listed, shortened
from plr.protos.model.ids import Role
from plr.protos.model.members import NO_REVOCATIONS, RevocationSet
from plr.protos.model.status import SyncState

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence

    from plr.protos.model.mapping import ServiceMapping
    from plr.protos.model.report import PathReport
    from plr.protos.model.status import ResourceStatus, SidecarStatus

MAX_LINES_OF_SIDECAR = 256
"""Most lines on one sidecar: its claims of what it offers, lacks or reaches must not hide the others."""

MAX_LINE_CHARACTERS = 1000
"""Characters of each line."""

MAX_HINTED = 100
"""Longest service name, in characters, for which a similar one is sought."""
MAX_SIMILAR_NAMES = 8
"""Similar names considered, since a cloud may offer some of them itself."""
MAX_COMPARED = 20_000_000
"""Pairs of characters compared in all, at most a second's work: 1,000 names with 50 others of 20 characters."""

_DAY_S = 86_400.0

_HEADER = ("NAME", "ROLE", "STREAM", "LEASE", "PEERS", "MAPPING", "SERVICES", "SOFTWARE")


def render(sidecars: Sequence[SidecarStatus], own: RevocationSet = NO_REVOCATIONS, now_wall: float = 0.0) -> str:
    """Return one row a sidecar, then the mapping that each robot was sent and the paths that it is based on.

    `own` holds the revocation lists of the control plane; `now_wall` is seconds since 1970.
    """
    # What others claim to have is no proof of a newer list.
    of_own = {one.ca: one.number for one in own.lists}
    about_own = _revocations(own, of_own, now_wall)
    lines = [f"control plane: {line}" for line in about_own]
    if not sidecars:
        return "\n".join([*lines, "no sidecars"])
    lines += columns([_HEADER, *(_row(status) for status in sidecars)])
    hints = _Hints({offer.name for one in sidecars if one.peer.role is Role.CLOUD for offer in one.peer.offers})
    for status in sidecars:
        details = [*_details(status)]
        wrong = [*_unmet(status, hints), *_untyped(status), *_unserved(status)]
        wrong += _revocations(status.revocations, of_own, now_wall)
        details += ((line, True) for line in wrong)
        if details:
            if len(details) > MAX_LINES_OF_SIDECAR:
                details.sort(key=lambda detail: not detail[1])
            shown = (shortened(line, MAX_LINE_CHARACTERS) for line, _ in details[:MAX_LINES_OF_SIDECAR])
            lines += ["", f"{status.peer.name}:", *(f"  {line}" for line in shown)]
        if len(details) > MAX_LINES_OF_SIDECAR:
            lines.append(f"  and {len(details) - MAX_LINES_OF_SIDECAR} more: plr status {status.peer.name} --json")
    abridged = sum(status.abridged for status in sidecars)
    if abridged:
        what = f"mapping and paths of {abridged} sidecars without problems"
        lines += ["", f"{what} are not shown; plr status NAME, or --all, shows them"]
    return "\n".join(lines)


def _row(status: SidecarStatus) -> tuple[str, ...]:
    stream = "open" if status.connected else "lost"
    if status.peer.draining:
        stream = "leaving"
    services = [offer.name for offer in status.peer.offers] + [use.name for use in status.uses]
    return (
        status.peer.name,
        status.peer.role.value,
        stream,
        f"{status.lease_left_s:.1f} s",
        status.peers.state.value,
        status.mapping.state.value if status.peer.role is Role.ROBOT else "-",
        listed(services),
        status.software_version or "-",
    )


def _details(status: SidecarStatus) -> Iterator[tuple[str, bool]]:
    """Yield lines, and whether each is about something that is wrong."""
    for name, resource in (("peers", status.peers), ("mapping", status.mapping)):
        if resource.state is SyncState.REJECTED:
            yield f"{name} {_rejection(resource)}", True
    if status.refused_offers:
        yield f"REFUSED by the policy: {', '.join(status.refused_offers)} (offered here, announced to no robot)", True
    for mapping in status.services:
        yield _mapping(mapping, status.paths), not mapping.assignments
    for use in status.uses:
        if use.fallback_up is not None:
            state = "ready on the robot" if use.fallback_up else "MISSING: its node does not run, or has another type"
            yield f"{use.name}: fallback {state}", not use.fallback_up
    lines = columns([_path(path) for path in status.paths])
    yield from ((line, not path.up) for line, path in zip(lines, status.paths, strict=True))
    for one in status.faults:
        yield f"{one.interface} {one.fault.value.upper()}: {one.text}", True
    for interface in status.down:
        yield f"{interface} DOWN: the sidecar would use it, but it is missing or has no link or no address", True


def _unserved(status: SidecarStatus) -> Iterator[str]:
    for name in status.withdrawn:
        yield f"LOST {name}: a node there offered it, but none does now"
    for name, requests in status.unanswered.items():
        yield f"UNANSWERED {name}: received the last {requests} requests that robots measured, but answered none"


class _Hints:
    """Guesses which offered service is meant: cached, since many robots want the same, and bounded, since no member may
    make the operator wait."""

    def __init__(self, offered: Iterable[str]) -> None:
        self._offered = sorted(name for name in offered if len(name) <= MAX_HINTED)
        self._found: dict[str, list[str]] = {}
        self._left = MAX_COMPARED

    def of(self, name: str, but: Collection[str]) -> str:
        """Return the closest name that is not in `but`, as the end of a line."""
        if len(name) > MAX_HINTED:
            return ""
        if name not in self._found:
            self._left -= len(name) * sum(map(len, self._offered))
            self._found[name] = (
                difflib.get_close_matches(name, self._offered, MAX_SIMILAR_NAMES) if self._left >= 0 else []
            )
        close = next((other for other in self._found[name] if other not in but), name)
        return f"; did you mean {close}?" if close != name else ""


def _unmet(status: SidecarStatus, hints: _Hints) -> Iterator[str]:
    own = {offer.name for offer in status.peer.offers}
    for name in status.unmet:
        hint = hints.of(name, own)  # a cloud does not mean what it offers itself
        whose = "no server that it knows" if status.peer.role is Role.ROBOT else "no node there"
        why = "" if status.peer.role is Role.ROBOT else ", or none that can be called; plr doctor there says which"
        yield f"UNMET {name}: configured, but {whose} offers it{hint or why}"
    for name in status.unreached:
        yield f"UNREACHED {name}: servers that it knows offer it, but it reaches none of them"


def _untyped(status: SidecarStatus) -> Iterator[str]:
    what = "carried" if status.peer.role is Role.ROBOT else "offered"
    for name in status.untyped:
        yield f"UNTYPED {name}: not {what}: its service type is not installed there; plr doctor there names it"


def _revocations(held: RevocationSet, of_own: Mapping[int, int], now_wall: float) -> Iterator[str]:
    """Yield a line for each list held; `of_own` has the numbers of the control plane's own lists, by CA."""
    for one in held.lists:
        age_s = now_wall - one.signed_at_s
        age = f"{age_s / _DAY_S:.1f} days ago" if age_s >= 0.0 else f"{-age_s:.0f} s FROM NOW: a clock is wrong"
        own = of_own.get(one.ca)
        if own is None or one.number > own:
            yield f"claims revocation list {one.number}, which the control plane does not have, signed {age}"
            continue
        older = f": OLDER than the control plane's {own}" if one.number < own else ""
        yield f"revocation list {one.number}, signed {age}{older}"
    if held.too_old:
        yield f"REVOCATION LIST TOO OLD of {held.too_old} CAs: it talks to none of their nodes; do: plr ca publish"


def _rejection(resource: ResourceStatus) -> str:
    kept = f"keeps {resource.version_acked}" if resource.version_acked else "holds none"
    return f"REJECTED version {resource.version_sent}, {kept}: {resource.error}"


def _mapping(mapping: ServiceMapping, paths: Iterable[PathReport]) -> str:
    if not mapping.assignments:
        live = ", ".join(f"{path.interface} -> {path.server}" for path in paths if path.up)
        then = f"if the robot knows a server of it, requests go over what is up: {live}" if live else "no path is up"
        return f"{mapping.service}: no mapping ({mapping.reason}); {then}"
    pairs = ", ".join(f"{assignment.interface} -> {assignment.server}" for assignment in mapping.assignments)
    return f"{mapping.service}: {pairs} (predicted miss {mapping.predicted_miss:.3g}; {mapping.reason})"


def _path(path: PathReport) -> tuple[str, ...]:
    median = path.rtt.quantile(0.5)
    rtt = f"rtt {median * 1000:.1f} ms" if math.isfinite(median) else "rtt -"
    lost = f"lost {path.datagrams_lost} of {path.datagrams_sent} since the last report"
    return (f"{path.interface} -> {path.server}", "up" if path.up else "DOWN", rtt, lost)
