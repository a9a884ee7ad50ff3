"""Builds the sidecar's Prometheus metrics at scrape time from the plain counters that the cores keep.

No code of prometheus_client runs where datagrams move: a scrape reads the counters on its own thread.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from prometheus_client import CollectorRegistry, ProcessCollector
from prometheus_client.core import HistogramMetricFamily, InfoMetricFamily
from prometheus_client.registry import Collector

from plr.protos.base.host_port import split_host_port
from plr.protos.model.stream import ResourceKind
from plr.protos.program.metrics_server import MetricsServer
from plr.protos.trust.revocation_views import revocation_gauges
from plr.sidecar.core.control.watch import LEAVE_CAUSES
from plr.sidecar.core.control.ways import DIAL_DROPS
from plr.sidecar.core.engine.revocation_exchange import EXCHANGES
from plr.sidecar.local.server import REFUSALS
from plr.sidecar.observe.metric_families import by_one, counter, cumulative, gauge
from plr.sidecar.state.store import FAILURES

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from prometheus_client import Metric

    from plr.protos.model.ids import InterfaceName, ServiceName
    from plr.protos.trust.identity import Identity
    from plr.sidecar.control.revocations import RevocationState
    from plr.sidecar.core.control.session import ControlStats
    from plr.sidecar.core.seam.stats import EngineStats, LinkStats
    from plr.sidecar.ros.stats import BridgeStats

_OUTCOMES = ("ok", "deadline_missed", "failed", "rejected")


@dataclass(frozen=True, slots=True)
class MetricSources:
    """Sources of the counters; each is called at every scrape, on the scrape's thread, and must not block."""

    name: str
    role: str
    version: str
    engine: Callable[[], EngineStats]
    links: Callable[[], Iterable[LinkStats]]
    interfaces: Callable[[], Mapping[InterfaceName, bool]]
    """Wanted interfaces, and whether each can carry anything."""
    control: Callable[[], ControlStats]
    connected: Callable[[], bool]
    """Whether the control plane is reachable."""
    bridge: Callable[[], BridgeStats] | None
    unmet: Callable[[], Iterable[str]]
    """Services that the configuration names but nobody serves."""
    state_failures: Callable[[], Mapping[str, int]]
    """Failures to read or write files of the state folder, by kind."""
    certificate: Callable[[], Identity | None]
    """Identity in the certificate in use; None in insecure mode."""
    files_refused: Callable[[], bool]
    """Whether the TLS files on disk are refused."""
    revocations: Callable[[], RevocationState | None]
    """The revocation lists in use; None in insecure mode."""
    local_refused: Callable[[], Mapping[str, int]]
    """Refusals of the local socket, by reason."""


class SidecarCollector(Collector):
    """Turns the counters into metric families."""

    def __init__(self, sources: MetricSources) -> None:
        self._sources = sources

    def collect(self) -> Iterator[Metric]:
        """Yield all metrics of the sidecar."""
        sources = self._sources
        info = InfoMetricFamily("plr_sidecar", "Name, role and version of this sidecar.")
        info.add_metric((), {"name": sources.name, "role": sources.role, "version": sources.version})
        yield info
        yield from _requests(sources.engine())
        yield gauge(
            "plr_interface_in_use",
            "1 while the interface can carry data; 0 while it is configured, but missing, down or without an address.",
            ("interface",),
            {(name,): float(used) for name, used in sources.interfaces().items()},
        )
        yield from _links(list(sources.links()))
        yield from _control(sources.control(), sources.connected(), sources.engine())
        if sources.bridge is not None:
            yield from _bridge(sources.bridge())
        yield gauge(
            "plr_service_unmet",
            "1 for each service that the configuration names and that nobody serves.",
            ("service",),
            {(name,): 1.0 for name in sources.unmet()},
        )
        yield from _certificate(sources.certificate(), sources.files_refused())
        yield from _revocations(sources.revocations(), sources.engine())
        yield counter(
            "plr_local_refused",
            "Connections and requests that the local socket refused.",
            ("reason",),
            by_one(dict.fromkeys(REFUSALS, 0) | dict(sources.local_refused())),
        )
        yield counter(
            "plr_state_failures",
            "Files of the state folder that could not be read or written.",
            ("reason",),
            by_one(dict.fromkeys(FAILURES, 0) | dict(sources.state_failures())),
        )


def serve_metrics(listen: str, sources: MetricSources) -> MetricsServer:
    """Serve /metrics on `listen` (address:port), as soon as that is available."""
    registry = CollectorRegistry()
    registry.register(SidecarCollector(sources))
    ProcessCollector(registry=registry)
    host, port = split_host_port(listen)
    return MetricsServer(host, port, registry)


def _certificate(own: Identity | None, files_refused: bool) -> Iterator[Metric]:
    if own is None:
        return
    yield gauge(
        "plr_certificate_expiry_timestamp_seconds",
        "When the certificate in use expires, in seconds since 1970.",
        (),
        {(): own.not_after},
    )
    yield gauge(
        "plr_tls_files_refused",
        "1 while the certificate files on disk are refused, and those read before stay in use.",
        (),
        {(): float(files_refused)},
    )


def _revocations(own: RevocationState | None, stats: EngineStats) -> Iterator[Metric]:
    if own is None:
        return
    for name, text, by_ca in revocation_gauges(own.lists, time.time()):
        yield gauge(name, text, ("ca",), by_ca)
    yield gauge(
        "plr_revocation_lists_too_old",
        "CAs whose list is older than max_revocation_age_s, so their nodes are refused.",
        (),
        {(): len(own.too_old)},
    )
    if math.isfinite(own.max_age_s):
        yield gauge(
            "plr_revocation_list_max_age_seconds",
            "The configured max_revocation_age_s; absent if lists may have any age.",
            (),
            {(): own.max_age_s},
        )
    yield counter(
        "plr_revocation_lists",
        "Revocation lists exchanged with peers.",
        ("what",),
        {(what,): stats.revocations[what] for what in EXCHANGES},
    )


def _requests(stats: EngineStats) -> Iterator[Metric]:
    yield counter(
        "plr_requests",
        "Requests of local applications by outcome.",
        ("service", "outcome"),
        _all_outcomes(dict(stats.requests)),
    )
    durations = HistogramMetricFamily(
        "plr_request_duration_seconds", "Time from a request to its first response.", labels=("service",)
    )
    for service, histogram in dict(stats.durations).items():
        buckets, total_s = cumulative(histogram)
        durations.add_metric((service,), buckets, total_s)
    yield durations
    yield gauge("plr_requests_in_flight", "Requests without a response yet.", (), {(): stats.in_flight})
    yield counter(
        "plr_path_wins",
        "First responses by the path that brought them.",
        ("interface", "peer", "service"),
        stats.wins,
    )
    yield counter(
        "plr_duplicate_responses",
        "Responses to requests that another copy had answered.",
        (),
        {(): stats.duplicate_responses},
    )
    yield counter(
        "plr_copies_called_off",
        "Copies of requests that are no longer awaited, because another copy was answered.",
        ("interface", "peer", "service"),
        stats.called_off,
    )
    yield counter(
        "plr_copies_explored",
        "Copies sent over paths that the mapping does not use, to measure these paths.",
        ("interface", "peer", "service"),
        stats.explored,
    )
    yield counter(
        "plr_copies_hedged",
        "Copies sent because the answer to another copy took long.",
        ("interface", "peer", "service"),
        stats.hedged,
    )
    yield counter(
        "plr_copy_bytes",
        "Bytes of requests sent, without headers and repair symbols, as first or extra copies.",
        ("interface", "service", "copy"),
        stats.copy_bytes,
    )
    yield counter(
        "plr_copies_refused",
        "Extra copies that were not sent, because the interface's budget forbade them.",
        ("interface", "service", "limit"),
        stats.copies_refused,
    )
    yield counter(
        "plr_bad_answers",
        "Answers that could not be delivered; other servers are preferred for a while.",
        ("peer", "service"),
        stats.bad_answers,
    )
    yield counter(
        "plr_late_responses_dropped",
        "Responses after the deadline that drop_late kept from the application.",
        ("service",),
        by_one(stats.late_dropped),
    )
    yield counter(
        "plr_executions",
        "Requests from robots by what the cloud's sidecar did with them.",
        ("service", "result"),
        stats.executions,
    )
    yield counter(
        "plr_messages_dropped",
        "Messages and table entries dropped above the datagram layer.",
        ("reason",),
        by_one(stats.dropped),
    )


def _all_outcomes(requests: dict[tuple[ServiceName, str], int]) -> dict[tuple[str, ...], int]:
    """Start every outcome of a service at 0: a counter that appears at 1 has not increased for Prometheus."""
    services = {service for service, _ in requests}
    found: dict[tuple[str, ...], int] = {(service, outcome): 0 for service in services for outcome in _OUTCOMES}
    found |= {(service, outcome): count for (service, outcome), count in requests.items()}
    return found


def _links(links: list[LinkStats]) -> Iterator[Metric]:
    datagrams: dict[tuple[str, ...], float] = {}
    dropped: dict[tuple[str, ...], float] = {}
    transferred: dict[tuple[str, ...], float] = {}
    up: dict[tuple[str, ...], float] = {}
    rtt: dict[tuple[str, ...], float] = {}
    sent: dict[tuple[str, ...], float] = {}
    lost: dict[tuple[str, ...], float] = {}
    late: dict[tuple[str, ...], float] = {}
    path_bytes: dict[tuple[str, ...], float] = {}
    path_mtu: dict[tuple[str, ...], float] = {}
    phase: dict[tuple[str, ...], float] = {}
    offload: dict[tuple[str, ...], float] = {}
    for link in links:
        datagrams |= {(link.interface, *key): count for key, count in dict(link.datagrams).items()}
        dropped |= {(link.interface, key): count for key, count in dict(link.dropped).items()}
        transferred |= {(link.interface, key): count for key, count in dict(link.bytes).items()}
        offload |= {(link.interface, key): on for key, on in dict(link.offload).items()}
        for peer, path in dict(link.paths).items():
            labels = (link.interface, peer)
            up[labels] = path.up
            if path.srtt_s > 0.0:
                rtt[labels] = path.srtt_s
            sent[labels] = path.datagrams_sent
            lost[labels] = path.datagrams_lost
            late[labels] = path.spurious_losses
            path_bytes[labels] = path.bytes_sent
            path_mtu[labels] = path.max_datagram
            phase[labels] = path.key_phase
    of_path = ("interface", "peer")
    yield counter("plr_datagrams", "UDP datagrams sent and received.", ("interface", "direction", "kind"), datagrams)
    yield counter(
        "plr_datagrams_dropped", "Datagrams that were refused or could not be sent.", ("interface", "reason"), dropped
    )
    yield counter("plr_bytes", "UDP payload bytes sent and received.", ("interface", "direction"), transferred)
    yield counter(
        "plr_interface_hangs",
        "Times that an interface's driver did not return in time.",
        ("interface",),
        by_one({link.interface: link.hangs for link in links}),
    )
    yield gauge(
        "plr_udp_offload", "Whether the kernel segments or coalesces datagrams.", ("interface", "direction"), offload
    )
    yield gauge("plr_path_up", "Whether the best path to the peer is alive.", of_path, up)
    yield gauge("plr_path_rtt_seconds", "Smoothed round-trip time of the best path to the peer.", of_path, rtt)
    yield counter("plr_path_datagrams_sent", "Numbered datagrams sent over the best path.", of_path, sent)
    yield counter("plr_path_datagrams_lost", "Datagrams sent over the best path and declared lost.", of_path, lost)
    yield counter("plr_path_spurious_losses", "Datagrams declared lost that had arrived.", of_path, late)
    yield counter("plr_path_bytes_sent", "UDP payload bytes sent over the best path.", of_path, path_bytes)
    yield gauge("plr_path_mtu_bytes", "Longest datagram that the best path is known to carry.", of_path, path_mtu)
    yield gauge(
        "plr_path_key_phase", "Changes of the keys that seal datagrams sent over the best path.", of_path, phase
    )


def _control(stats: ControlStats, connected: bool, engine: EngineStats) -> Iterator[Metric]:
    yield gauge("plr_mapping_version", "Version of the mapping in force, 0 for none.", (), {(): engine.mapping_version})
    yield gauge("plr_peers_version", "Version of the peers in force, 0 for none.", (), {(): engine.peers_version})
    yield counter(
        "plr_nacks",
        "Pushed peers and mappings that were refused.",
        ("resource",),
        {(resource.value,): stats.nacks[resource] for resource in ResourceKind},
    )
    yield counter(
        "plr_acks",
        "Pushed peers and mappings that were put in force.",
        ("resource",),
        {(resource.value,): stats.acks[resource] for resource in ResourceKind},
    )
    yield gauge("plr_control_plane_connected", "Whether the control plane is connected.", (), {(): connected})
    yield counter("plr_control_attempts", "Attempts to reach the control plane.", (), {(): stats.attempts})
    yield counter("plr_control_streams", "Streams that the control plane accepted.", (), {(): stats.streams})
    yield counter(
        "plr_control_reports",
        "Reports to the control plane.",
        ("result",),
        {("sent",): stats.reports, ("dropped",): stats.reports_dropped},
    )
    yield counter(
        "plr_control_messages_ignored",
        "Messages of the control plane that were ignored.",
        ("reason",),
        by_one(stats.ignored),
    )
    yield counter(
        "plr_control_connections",
        "TCP connections that control streams used, by interface.",
        ("interface",),
        by_one(stats.connections),
    )
    yield counter(
        "plr_control_connections_left",
        "TCP connections of control streams that were left for another way, by cause.",
        ("cause",),
        {(cause,): stats.connections_left[cause] for cause in LEAVE_CAUSES},
    )
    yield counter(
        "plr_control_dial_dropped",
        "Addresses that the control stream's dialer ignored and connections that it refused, by reason.",
        ("reason",),
        {(reason,): stats.dial_drops[reason] for reason in DIAL_DROPS},
    )


def _bridge(stats: BridgeStats) -> Iterator[Metric]:
    passed = {
        (direction, service): count
        for direction, passed_on in (
            ("request_from_application", stats.requests_taken),
            ("answer_to_application", stats.answers_sent),
            ("request_to_server", stats.requests_sent),
            ("answer_from_server", stats.answers_taken),
        )
        for service, count in dict(passed_on).items()
    }
    yield counter(
        "plr_bridge_messages", "Messages exchanged with the local ROS graph.", ("direction", "service"), passed
    )
    yield counter(
        "plr_bridge_unanswered",
        "Requests of local applications that will never be answered.",
        ("service", "reason"),
        stats.unanswered,
    )
    yield counter("plr_bridge_refused", "Requests of robots that were not run.", ("service", "reason"), stats.refused)
    yield counter(
        "plr_bridge_abandoned",
        "Requests at local servers whose answer nobody waits for any more.",
        ("service",),
        by_one(stats.abandoned),
    )
    yield counter(
        "plr_fallback_requests",
        "Requests that were left to the fallback on this robot, by outcome.",
        ("service", "outcome"),
        stats.fallbacks,
    )
    yield gauge(
        "plr_fallback_up", "Whether a service's fallback can be asked.", ("service",), by_one(stats.fallback_up)
    )
    yield gauge(
        "plr_fallback_expected_seconds",
        "Expected time of a service's fallback for one request.",
        ("service",),
        by_one(stats.fallback_takes_s),
    )
    yield counter(
        "plr_bridge_dropped", "Events and messages that the bridge dropped.", ("reason",), by_one(stats.dropped)
    )
    yield counter("plr_bridge_errors", "Failures of rmw or the bridge.", ("where",), by_one(stats.errors))
    yield gauge("plr_bridge_pending", "Requests in the bridge that wait for an answer.", (), {(): stats.pending})
    yield gauge("plr_services_carried", "Services offered here now.", (), {(): len(stats.carried)})
    yield gauge(
        "plr_services_left_alone",
        "Services offered by live servers that a local node already serves.",
        (),
        {(): len(stats.left_alone)},
    )
    yield gauge(
        "plr_services_without_type",
        "Services not carried because their type is not installed.",
        (),
        {(): len(stats.missing_types)},
    )
