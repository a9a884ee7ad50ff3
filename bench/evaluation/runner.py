"""Runs a scenario with a contender in the lab: starts all on a good network, replays the window, keeps the records."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from bench.dataplane.statistics import MS, Calls, quantile
from bench.evaluation.contenders import PATHS, WARM, World
from bench.evaluation.outcome import UNANSWERED_S, Outcome, Request
from lab import Lab
from lab.pressure import BUSY_SHARE, CpuPressure

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from bench.dataplane.remote import Remote
    from bench.evaluation.contenders import Contender
    from bench.evaluation.scenario import Scenario
    from lab import LinkStats

WARM_UP_S = 3.0
"""Seconds of the scenario's requests on the good network before the window."""
LEAD_S = 1.0
"""Time from the order to replay to the start of the window: by then links and client have received it."""
DRAIN_S = 30.0
"""Time by which a blocked client has ended its run, once the links are good again."""
MOST_LATE_S = 0.005
"""Tolerated P99 lateness of the emulator's packets; more disturbs a run."""
MOST_LATE_STEP_S = 0.1
"""Tolerated lateness of the worst step of the trace."""


def run(scenario: Scenario, contender: Contender, folder: Path, *, seed: int = 1) -> Outcome:
    """Run a scenario with a contender; logs go to `folder`.

    Raises:
        LabError, LabConfigError: the lab or the trace failed.
        SystemFailureError, RemoteError, RuntimeError: the contender did not start, or ended.
    """
    traffic = scenario.traffic
    trace = scenario.trace()
    plan = {"size": traffic.request_bytes, "rate_hz": traffic.rate_hz}
    notes: dict[str, Any] = {}
    with Lab(contender.lab(), seed=seed) as lab, contender.start(World(lab, folder, traffic, notes)) as clients:
        _call(clients, {**plan, "count": max(1, round(WARM_UP_S * traffic.rate_hz))})
        before = {name: lab.link(name).stats(reset=True) for name in contender.carriers}
        pressure = CpuPressure()
        start = time.monotonic() + LEAD_S
        lab.replay(trace, {name: PATHS[name] for name in contender.carriers}, start=start)
        seconds = scenario.duration_s + UNANSWERED_S
        whole = {**plan, "count": scenario.count, "start_s": start, "seconds": seconds, "grace_s": UNANSWERED_S}
        for client in clients:
            client.begin("call", **whole)
        for client in clients:
            client.ready(start + seconds - time.monotonic())
        busy = pressure.share()
        after = {name: lab.link(name).stats() for name in contender.carriers}
        calls = _finish(clients, lab, contender.carriers)
    sent = {name: after[name].up.sent_bytes - before[name].up.sent_bytes for name in after}
    late_s = [at - start - number / traffic.rate_hz for one in calls for number, at in enumerate(one.sent_s)]
    return Outcome(
        scenario=scenario.name,
        case=scenario.case,
        contender=contender.name,
        deadline_ms=traffic.deadline_ms,
        requests=_requests(calls, start, scenario),
        bytes_sent=sent,
        disturbances=disturbances(after, busy),
        conditions={
            "cpu_pressure": busy,
            "unsent": sum(max(0, scenario.count - len(one.sent_s)) for one in calls),
            "client_late_p99_ms": (quantile(late_s, 0.99) or 0.0) * MS,
            **notes,
            "links": {name: _conditions(stats) for name, stats in after.items()},
        },
    )


def disturbances(links: Mapping[str, LinkStats], busy: float | None) -> tuple[str, ...]:
    """Return why a run says more about the machine than about the contender; empty if it counts."""
    found = []
    for name, stats in links.items():
        if stats.lateness.p99_s > MOST_LATE_S:
            found.append(f"{name}: packets {stats.lateness.p99_s * MS:.1f} ms late (P99)")
        if stats.step_lateness.max_s > MOST_LATE_STEP_S:
            found.append(f"{name}: a step of the trace {stats.step_lateness.max_s * MS:.0f} ms late")
        lost = stats.up.kernel_drops + stats.down.kernel_drops
        if lost:
            found.append(f"{name}: {lost} packets lost before the emulator saw them")
    if busy is not None and busy > BUSY_SHARE:
        found.append(f"some program waited for a processor for {busy:.0%} of the run")
    return tuple(found)


def _call(clients: Sequence[Remote], plan: Mapping[str, Any]) -> None:
    for client in clients:
        client.begin("call", **plan)
    for client in clients:
        client.finish()


def _finish(clients: Sequence[Remote], lab: Lab, carriers: Sequence[str]) -> list[Calls]:
    """Return the clients' logs; requests still blocked may leave now, but no answer counts any more."""
    for name in carriers:
        lab.link(name).set(WARM)
    return [Calls.of(client.finish(DRAIN_S)) for client in clients]


def _requests(logs: Sequence[Calls], start: float, scenario: Scenario) -> tuple[Request, ...]:
    """Return each request with the first time at which it left, and its first answer."""
    requests = []
    for number in range(scenario.count):
        sent = [log.sent_s[number] - start for log in logs if number < len(log.sent_s)]
        answered = [
            log.sent_s[number] - start + latency_s
            for log in logs
            if number < len(log.sent_s) and (latency_s := log.latency_s[number]) is not None
        ]
        due_s = number / scenario.traffic.rate_hz
        requests.append(Request(due_s, min(sent, default=None), min(answered, default=None)))
    return tuple(requests)


def _conditions(stats: LinkStats) -> dict[str, Any]:
    return {
        "late_p99_ms": stats.lateness.p99_s * MS,
        "late_max_ms": stats.lateness.max_s * MS,
        "step_late_max_ms": stats.step_lateness.max_s * MS,
        "realtime": stats.realtime,
        "queue_drops": {
            direction: {reason.value: count for reason, count in side.drops.items() if count}
            for direction, side in (("up", stats.up), ("down", stats.down))
        },
    }
