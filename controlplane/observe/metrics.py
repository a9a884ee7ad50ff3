"""Exports the Prometheus metrics of the control plane (names: docs/operate/metrics.md).

The exporter serves from a thread of its own: the loop leaves finished values for it, and it never looks into the
core. The registry is our own, without the interpreter's collectors and `_created` series, which have no base units
and which `promtool check metrics` reports. The process collector shows its memory and start time.
"""

from __future__ import annotations

import time
from collections import Counter
from typing import TYPE_CHECKING

import prometheus_client
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

from plr.controlplane.observe.fleet_metrics import FleetCollector
from plr.controlplane.serve import access, handshakes, stream_limits, tls_gate
from plr.protos.model.fleet_events import EventLogState
from plr.protos.model.ids import Role
from plr.protos.model.status import SyncState
from plr.protos.model.stream import ResourceKind
from plr.protos.program.metrics_server import MetricsServer
from plr.protos.trust import identity
from plr.protos.trust.revocation_views import revocation_gauges

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from prometheus_client import Metric

    from plr.controlplane.core.control.control import ControlCore
    from plr.controlplane.observe.fleet_metrics import Fleet
    from plr.controlplane.serve.stun_server import StunServer
    from plr.protos.trust.identity import Identity, RevocationList

SOLVE_BUCKETS_S = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0)
"""Buckets of the solving time: one robot takes milliseconds, a hundred a quarter of a second, a thousand seconds."""


NO_EVENTS = EventLogState()

NOTHING_DROPPED: Mapping[str, int] = {
    "report_slowed": 0,
    "log_line_left_out": 0,
    "share_forgotten": 0,
}

REFUSAL_REASONS = (
    identity.MALFORMED,
    identity.UNTRUSTED,
    identity.EXPIRED,
    identity.NOT_YET_VALID,
    identity.WRONG_ROLE,
    identity.REVOKED,
    handshakes.NO_CERTIFICATE,
    handshakes.OLD_TLS,
    handshakes.NOT_TLS,
    handshakes.CLIENT_REFUSED,
    handshakes.HANDSHAKE_TIMEOUT,
    handshakes.HANDSHAKE_ABORTED,
    handshakes.HANDSHAKE_FAILED,
    tls_gate.TOO_MANY_HANDSHAKES,
    tls_gate.TOO_MANY_CONNECTIONS,
    tls_gate.GAVE_UP,
    stream_limits.TOO_MANY_STREAMS,
    stream_limits.TOO_FAST,
    access.TOO_MANY_CALLS,
)
"""Labels of plr_refused_connections_total, present from the start."""


class _Values:
    """Hands the values of the last `update` to the exporter's thread."""

    def __init__(self) -> None:
        self.families: Sequence[Metric] = ()

    def collect(self) -> Iterable[Metric]:
        return self.families


class Metrics:
    """All metrics of one control plane."""

    def __init__(self) -> None:
        prometheus_client.disable_created_metrics()  # type: ignore[no-untyped-call]  # untyped in the library
        self.registry = prometheus_client.CollectorRegistry()
        self._values = _Values()
        self.solve_duration = prometheus_client.Histogram(
            "plr_solve_duration_seconds",
            "Time one solving of the assignment took.",
            registry=self.registry,
            buckets=SOLVE_BUCKETS_S,
        )
        self.streams_ended = prometheus_client.Counter(
            "plr_streams_ended_total",
            "Control streams ended by the control plane, by gRPC status.",
            ["code"],
            registry=self.registry,
        )
        self.unknown_messages = prometheus_client.Counter(
            "plr_unknown_messages_total",
            "Messages of sidecars that were ignored because only a newer control plane knows their kind.",
            registry=self.registry,
        )
        self._refused_connections = prometheus_client.Counter(
            "plr_refused_connections_total",
            "Connections and calls refused or ended because of who made them or how, by reason.",
            ["reason"],
            registry=self.registry,
        )
        for reason in REFUSAL_REASONS:
            self._refused_connections.labels(reason)
        self._own: tuple[Identity, Mapping[int, RevocationList | None]] | None = None
        self.files_refused = False
        """Whether the TLS files on disk are refused."""
        self.policy_reloads = prometheus_client.Counter(
            "plr_policy_reloads_total",
            "Times that the access policy was reloaded, by result.",
            ["result"],
            registry=self.registry,
        )
        self.registry.register(self._values)
        prometheus_client.ProcessCollector(registry=self.registry)

    def refused_connection(self, reason: str) -> None:
        """Count a refused or ended connection or call; `reason` is one of REFUSAL_REASONS."""
        self._refused_connections.labels(reason).inc()

    def own_certificate(self, identity: Identity, lists: Mapping[int, RevocationList | None]) -> None:
        """Show this certificate and these revocation lists (`Trust.lists`) as in use from now on."""
        self._own = identity, lists

    def watch_fleet(self, ask: Callable[[], Fleet]) -> None:
        """Export each member too; `ask` gets them, on a thread other than the loop's."""
        self.registry.register(FleetCollector(ask))

    def start(self, host: str, port: int) -> tuple[str, int]:
        """Serve the metrics over HTTP and return the address."""
        return host, MetricsServer(host, port, self.registry).port

    def update(
        self,
        core: ControlCore,
        stun_servers: Sequence[StunServer],
        superseded: int,
        events: EventLogState = NO_EVENTS,
        dropped: Mapping[str, int] = NOTHING_DROPPED,
    ) -> None:
        """Take the current values."""
        self._values.families = (
            *_members(core),
            *_sync(core),
            *_plan(core),
            *_drops(core, superseded, dropped, events),
            *_events(events),
            *_stun(stun_servers),
            *_certificate(self._own, self.files_refused),
            _loop(),
        )


def _gauge(name: str, text: str, labels: Sequence[str], values: Mapping[tuple[str, ...], float]) -> Metric:
    family = GaugeMetricFamily(name, text, labels=labels)
    for key, value in values.items():
        family.add_metric(key, value)
    return family


def _counter(name: str, text: str, labels: Sequence[str], values: Mapping[tuple[str, ...], float]) -> Metric:
    family = CounterMetricFamily(name, text, labels=labels)
    for key, value in values.items():
        family.add_metric(key, value)
    return family


def _members(core: ControlCore) -> Iterable[Metric]:
    registered: Counter[tuple[str, ...]] = Counter({(role.value,): 0 for role in Role})
    connected = registered.copy()
    for sidecar in core.registry:
        registered[sidecar.role.value,] += 1
        connected[sidecar.role.value,] += sidecar.stream is not None
    counters = core.registry.counters
    yield _gauge("plr_connected_sidecars", "Sidecars with an open control stream.", ["role"], connected)
    yield _gauge("plr_registered_sidecars", "Sidecars whose lease has not ended.", ["role"], registered)
    yield _counter(
        "plr_leases_postponed_total",
        "Times that the end of a lease was postponed because the sidecar had unread bytes; a few at most for each.",
        [],
        {(): core.registry.postponed.counted},
    )
    yield _counter(
        "plr_registrations_refused_total",
        "Registrations refused, by reason.",
        ["reason"],
        {(refusal.name.lower(),): count for refusal, count in counters.refused.items()},
    )
    yield _counter(
        "plr_departures_total",
        "Sidecars that left the registry, by reason.",
        ["reason"],
        {(reason.value,): count for reason, count in counters.departed.items()},
    )


def _sync(core: ControlCore) -> Iterable[Metric]:
    states: Counter[tuple[str, ...]] = Counter(
        {(kind.value, state.name.lower()): 0 for kind in ResourceKind for state in SyncState}
    )
    # Count first and name the few results afterwards: naming thousands of states takes milliseconds.
    for (kind, state), count in Counter((kind, state) for _, kind, state in core.sync_states()).items():
        states[kind.value, state.name.lower()] += count
    text = "Sidecars by the state of what was pushed to them."
    yield _gauge("plr_resource_sync", text, ["resource", "state"], states)
    yield _counter(
        "plr_nacks_total",
        "Pushed resources that a sidecar refused.",
        ["resource"],
        {(kind.value,): core.counters.nacks[kind] for kind in ResourceKind},
    )
    yield _counter(
        "plr_acks_total",
        "Pushed resources that a sidecar applied.",
        ["resource"],
        {(kind.value,): core.counters.acks[kind] for kind in ResourceKind},
    )


def _plan(core: ControlCore) -> Iterable[Metric]:
    yield _gauge(
        "plr_plan_excess_interfaces",
        "Interfaces by which the running plan exceeds capacities.",
        [],
        {(): core.plan.relaxed},
    )
    yield _gauge(
        "plr_plan_gap_ratio",
        "How far the running plan's cost is above the bound that the solver proved, relative to the bound.",
        [],
        {(): core.plan.gap},
    )
    blocks = core.plan.blocks.values()
    yield _gauge(
        "plr_plan_targets_missed",
        "Services of robots whose mapping is predicted to miss more often than their target_miss.",
        [],
        {(): sum(bool(block.shortfall) for block in blocks)},
    )
    yield _gauge(
        "plr_plan_shared_domains",
        "Regions and carriers that copies of a request share, over the mappings of all robots' services.",
        [],
        {(): sum(len(block.shared) for block in blocks)},
    )
    yield _counter(
        "plr_relaxations_total",
        "Plans put in force that exceed capacities by another number of interfaces than the previous one.",
        [],
        {(): core.counters.relaxations},
    )
    yield _counter(
        "plr_solves_unproven_total",
        "Groups of assignments that the time limit left further from their bound than wanted.",
        [],
        {(): core.counters.unproven},
    )
    yield _counter(
        "plr_offers_refused_total",
        "Offers that the access policy does not let their clouds make.",
        [],
        {(): core.counters.offers_refused},
    )
    yield _counter("plr_reports_total", "Reports merged.", [], {(): core.counters.reports})


def _drops(core: ControlCore, superseded: int, dropped: Mapping[str, int], events: EventLogState) -> Iterable[Metric]:
    yield _counter(
        "plr_control_dropped_total",
        "What was dropped, by reason.",
        ["reason"],
        {
            ("histogram_evicted",): core.estimator.dropped,
            ("mapping_history_evicted",): core.history.dropped,
            ("departure_forgotten",): core.departed.forgotten,
            ("reach_forgotten",): core.reached.forgotten,
            ("unanswered_forgotten",): core.unanswered.forgotten,
            ("interface_unwatched",): core.faults.left_out,
            ("event_evicted",): events.evicted,
            ("event_too_often",): events.too_often,
            ("event_damaged",): events.damaged,
            ("removal_forgotten",): core.registry.counters.removals_forgotten,
            ("stale_answer",): core.counters.stale_answers,
            ("old_stream",): core.counters.old_stream_messages,
            ("report_of_cloud",): core.counters.reports_ignored,
            ("offer_of_robot",): core.counters.robot_offers_ignored,
            ("report_forbidden",): core.counters.report_entries_forbidden,
            ("announced_too_often",): core.restlessness.held,
            ("urgent_too_often",): core.urgency.held,
            ("interface_left_out",): core.counters.interfaces_left_out,
            **{(reason,): count for reason, count in dropped.items()},
            ("superseded_before_sent",): superseded,
        },
    )


def _events(events: EventLogState) -> Iterable[Metric]:
    yield _gauge("plr_events_kept", "Events of the fleet that are remembered.", [], {(): events.kept})
    yield _counter(
        "plr_event_write_failures_total",
        "Times that the event log could not be written.",
        [],
        {(): events.write_failures},
    )


def _certificate(
    known: tuple[Identity, Mapping[int, RevocationList | None]] | None, files_refused: bool
) -> Iterable[Metric]:
    if known is None:
        return
    own, lists = known
    now_wall = time.time()
    yield _gauge(
        "plr_certificate_expiry_timestamp_seconds",
        "When the certificate in use expires, in seconds since 1970.",
        [],
        {(): own.not_after},
    )
    yield _gauge(
        "plr_tls_files_refused",
        "1 while the certificate files on the disk are refused and the previous ones stay in use.",
        [],
        {(): float(files_refused)},
    )
    for name, text, by_ca in revocation_gauges(lists, now_wall):
        yield _gauge(name, text, ["ca"], by_ca)


def _loop() -> Metric:
    """Return the processor time of the loop; must run on the loop's thread."""
    text = "Processor time of the thread that serves all streams; it can use one core."
    return _counter("plr_loop_cpu_seconds_total", text, [], {(): time.thread_time()})


def _stun(servers: Sequence[StunServer]) -> Iterable[Metric]:
    outcomes: Counter[tuple[str, ...]] = Counter()
    for server in servers:
        outcomes.update({(outcome.value,): count for outcome, count in server.outcomes.items()})
        outcomes["send_failed",] += server.send_failures
        outcomes["receive_failed",] += server.receive_failures
        outcomes["buffer_full",] += server.buffer_full
    yield _counter("plr_stun_datagrams_total", "Datagrams on the STUN port, by outcome.", ["outcome"], outcomes)
