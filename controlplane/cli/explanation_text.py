"""Formats an explanation as text for a terminal."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from plr.controlplane.cli.text_table import columns
from plr.protos.model.explanation import AlternativeKind, Correlation
from plr.protos.model.fleet_events import Why
from plr.protos.model.redundancy_mode import RedundancyMode

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from plr.protos.base.histogram import Histogram
    from plr.protos.model.explanation import Alternative, Explanation, JointExplanation, MappingChange, PairExplanation
    from plr.protos.model.mapping import Assignment

LEAST_SHOWN = 1e-9
"""Smallest probability worth showing: with less it would take years to see one miss."""

MAX_LIVE = 8
"""Live paths named of a service without a mapping."""

LITTLE_GAIN = 0.5
"""If the other interface misses at least this share of what the better one misses, it gains little."""

_SENDING = {
    RedundancyMode.SINGLE: "each request goes over one of them, and over another one if its path or server fails",
    RedundancyMode.BACKUP: "each request goes over one of them, and over the next one if that copy is lost or silent",
    RedundancyMode.HEDGE: "each request goes over one of them, and over the next one if the answer is unusually late",
    RedundancyMode.ADAPTIVE: "each request goes over one of them, and over others as late as the allowed misses permit",
    RedundancyMode.SHARE: "a large request goes once, to one server, in parts over all their interfaces; "
    "a small one goes over all of them",
    RedundancyMode.REPLICATE: "each request goes over all of them at once",
}
"""What a robot does with the pairs of a mapping, by the service's redundancy mode."""

_PAIR_HEADER = (
    *("", "INTERFACE", "SERVER", "STATE", "MISS", "90 % BETWEEN", "REQUESTS", "PROBES"),
    *("RTT P50", "P99", "NETWORK P50", "P99", "COMPUTE P50", "P99"),
)


def render(explanation: Explanation) -> str:
    """Return the mapping in force, what it is based on, the alternatives, and how it came about."""
    found = explanation
    kind = "idempotent" if found.idempotent else "not idempotent: one server at a time"
    aim = f"cheapest that misses at most {found.target_miss:g}" if found.target_miss else f"objective {found.objective}"
    lines = []
    if found.gone_s is not None:
        why = found.gone_why.value if found.gone_why is not None else "unknown"
        # Its peers keep one whose lease expired, and may reach it.
        whom = " for the control plane" if found.gone_why is Why.LEASE_EXPIRED else ""
        lines += [
            f"{found.robot} IS GONE{whom} for {_age(found.gone_s)} ({why}): this shows what was known then",
            "",
        ]
    lines += [f"{found.robot} {found.service}: deadline {_ms(found.deadline_s)}, {kind}, {aim}"]
    for title, section in (
        ("mapping in force", list(_mapping(found))),
        ("pairs (times in ms, * in force)", list(_pairs(found))),
        ("servers whose answers cannot be delivered: other servers come first", list(columns(_penalties(found)))),
        ("robots that measured the servers' computing times", list(columns(_witnesses(found)))),
        (
            "interfaces that carried copies of the same requests",
            list(columns([_joint(joint) for joint in found.joints])),
        ),
        ("what other mappings would give", list(columns([_alternative(other) for other in found.alternatives]))),
        ("changes, newest first", list(columns([_change(change) for change in found.changes]))),
    ):
        if section:
            lines += ["", f"{title}:", *(f"  {line}" for line in section)]
    return "\n".join(lines)


def _mapping(found: Explanation) -> Iterator[str]:
    if found.mapping is None:
        yield "none has been sent yet"
        yield _without_mapping(found)
        return
    observed = f"recently observed {_probability(found.observed_miss)}" if found.observed_miss is not None else ""
    if found.mapping.assignments:
        yield _paths(found.mapping.assignments)
        if found.redundancy is not None:
            yield f"redundancy {found.redundancy.value}: {_SENDING[found.redundancy]}"
        cost = f"a request costs {found.cost_per_request:g}" if found.cost_per_request is not None else ""
        predicted = found.mapping.predicted_miss if found.predicted_miss is None else found.predicted_miss
        misses = [f"predicted miss {_probability(predicted)}", observed, cost]
    else:
        yield "it names no path"  # and so predicts nothing
        yield _without_mapping(found)
        misses = [f"miss {observed}" if observed else ""]
    if any(misses):
        yield ", ".join(filter(None, misses))
    age = f", in use for {_age(found.in_force_s)}" if found.in_force_s is not None else ""
    refused = f" ({found.sync.error})" if found.sync.error else ""
    yield f"version {found.sync.version_sent}, {found.sync.state.value}{refused}{age}"
    yield f"reason: {found.mapping.reason or '-'}"
    if found.mapping.explore is not None:
        yield f"explores {_path(found.mapping.explore)}: a few requests send one more copy there"


def _without_mapping(found: Explanation) -> str:
    """Return what a robot does for which the control plane has chosen no path."""
    live = [_path(pair.path) for pair in found.pairs if pair.up]
    more = f" and {len(live) - MAX_LIVE} more" if len(live) > MAX_LIVE else ""
    over = f"; it last reported these up: {', '.join(live[:MAX_LIVE])}{more}" if live else ""
    return f"meanwhile the robot itself chooses live paths to the servers of it that it knows, the fastest first{over}"


def _pairs(found: Explanation) -> Iterator[str]:
    if found.pairs:
        yield from columns([_PAIR_HEADER, *(_pair(pair) for pair in found.pairs)])
    if found.pairs_left_out:
        yield f"and {found.pairs_left_out} more"


def _pair(pair: PairExplanation) -> tuple[str, ...]:
    return (
        "*" if pair.chosen else "",
        _labelled(pair.path.interface, pair.carrier),
        _labelled(pair.path.server, pair.region),
        _state(pair),
        _probability(pair.miss.mean) if pair.miss is not None else "-",
        f"{_probability(pair.miss.low)} .. {_probability(pair.miss.high)}" if pair.miss is not None else "-",
        f"{pair.requests:.0f}",
        f"{pair.probes:.0f}",
        *_quantiles(pair.rtt),
        *_quantiles(pair.network),
        *_quantiles(pair.compute),
    )


def _state(pair: PairExplanation) -> str:
    state = {True: "up", False: "DOWN", None: "unknown"}[pair.up]
    return state + ", barred" * pair.barred + ", PENALTY" * (pair.penalty_s > 0.0)


def _penalties(found: Explanation) -> list[tuple[str, ...]]:
    of_servers = {pair.path.server: pair for pair in found.pairs if pair.penalty_s > 0.0}
    return [
        (
            f"{server}:",
            f"{pair.bad_answers} bad answer{'s' * (pair.bad_answers != 1)} to {found.robot} recently,",
            f"penalty ends in {_age(pair.penalty_s)}",
        )
        for server, pair in of_servers.items()
    ]


def _witnesses(found: Explanation) -> list[tuple[str, ...]]:
    """Return a line for each server, except those that only this robot calls."""
    of_servers = {pair.path.server: pair for pair in found.pairs if pair.witnesses}
    return [
        (
            f"{server}:",
            f"{pair.witnesses} robot{'s' * (pair.witnesses != 1)},",
            f"{pair.busiest_witness} counts for {pair.busiest_share:.0%}",
        )
        for server, pair in of_servers.items()
        if (pair.witnesses, pair.busiest_witness) != (1, found.robot)
    ]


def _labelled(name: str, label: str) -> str:
    return f"{name} ({label})" if label else name


def _quantiles(histogram: Histogram) -> tuple[str, str]:
    return _quantile(histogram, 0.5), _quantile(histogram, 0.99)


def _quantile(histogram: Histogram, q: float) -> str:
    value = histogram.quantile(q)
    if math.isnan(value):
        return "-"
    return "lost" if math.isinf(value) else f"{value * 1e3:.1f}"


def _joint(joint: JointExplanation) -> tuple[str, ...]:
    to = f", both to {joint.server}" if joint.server else ""
    shared = f" (they share {', '.join(joint.shared)})" if joint.shared else ""
    return (
        f"{joint.first} and {joint.second}{to}:",
        f"both missed {joint.both_missed:.0f} of {joint.requests:.0f},",
        f"{joint.expected:.2g} expected by chance",
        f"({joint.lift:.2g} times):",
        f"{joint.correlation.value}{_gain(joint)}{shared}",
    )


def _gain(joint: JointExplanation) -> str:
    """Return what joint failures mean for a copy over the second interface."""
    if joint.correlation is Correlation.INDEPENDENT:
        return ""
    rarer = min(joint.first_missed, joint.second_missed)
    return f": a second copy gains {'little' if joint.both_missed >= LITTLE_GAIN * rarer else 'less than it could'}"


def _alternative(other: Alternative) -> tuple[str, ...]:
    match other.kind:
        case AlternativeKind.OTHER:
            what = "instead"
        case AlternativeKind.ALONE:
            what = "alone"
        case AlternativeKind.WITHOUT:
            what = f"without {other.without}"
    paths = _paths(other.assignments)
    cost = f"costs {other.cost_per_request:g}" if other.cost_per_request is not None else ""
    return what, _probability(other.predicted_miss), cost, f"{paths} ({other.note})" if other.note else paths


def _change(change: MappingChange) -> tuple[str, ...]:
    mapping = change.mapping
    return (
        f"{_age(change.age_s)} ago",
        _probability(mapping.predicted_miss),
        f"{_paths(mapping.assignments)}: {mapping.reason}",
    )


def _paths(assignments: Sequence[Assignment]) -> str:
    return ", ".join(_path(assignment) for assignment in assignments) or "nowhere"


def _path(assignment: Assignment) -> str:
    return f"{assignment.interface} -> {assignment.server}"


def _probability(value: float) -> str:
    return f"{value:.2g}" if value >= LEAST_SHOWN or not value else f"< {LEAST_SHOWN:g}"


def _ms(seconds: float) -> str:
    return f"{seconds * 1e3:g} ms"


def _age(seconds: float) -> str:
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    if seconds < 7200.0:
        return f"{seconds / 60.0:.0f} min"
    return f"{seconds / 3600.0:.0f} h"
