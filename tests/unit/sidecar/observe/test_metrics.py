from __future__ import annotations

import subprocess
import threading
import urllib.request
from collections import Counter
from typing import TYPE_CHECKING

import pytest
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.parser import text_string_to_metric_families

from plr.protos.base.histogram import Histogram
from plr.protos.model.ids import InterfaceName, NodeName, ServiceName
from plr.protos.model.stream import ResourceKind
from plr.sidecar.core.control.session import ControlStats
from plr.sidecar.core.seam.stats import EngineStats, LinkStats, PathStats
from plr.sidecar.observe.metric_families import DURATION_BOUNDS_S, cumulative
from plr.sidecar.observe.metrics import MetricSources, SidecarCollector, serve_metrics
from plr.sidecar.ros.stats import BridgeStats

if TYPE_CHECKING:
    from plr.protos.program.metrics_server import MetricsServer

PLAN = ServiceName("/plan")
WLAN = InterfaceName("wlan0")
CLOUD = NodeName("cloud-a")

CONTRACT = {
    "plr_requests_total",
    "plr_request_duration_seconds",
    "plr_path_rtt_seconds",
    "plr_path_up",
    "plr_path_wins_total",
    "plr_duplicate_responses_total",
    "plr_datagrams_total",
    "plr_datagrams_dropped_total",
    "plr_bytes_total",
    "plr_mapping_version",
    "plr_nacks_total",
}
"""The sidecar's share of the metrics that users rely on."""


class Counters:
    """All counters of one sidecar."""

    def __init__(self) -> None:
        self.engine = EngineStats()
        self.links = [LinkStats(WLAN)]
        self.control = ControlStats()
        self.bridge = BridgeStats()
        self.state_failures: Counter[str] = Counter()

    def sources(self) -> MetricSources:
        return MetricSources(
            name="robot-1",
            role="robot",
            version="0.1.0",
            engine=lambda: self.engine,
            links=lambda: self.links,
            unmet=lambda: ["/where_i_am"],
            interfaces=lambda: {InterfaceName("wlan0"): True, InterfaceName("wwan0"): False},
            control=lambda: self.control,
            connected=lambda: True,
            bridge=lambda: self.bridge,
            state_failures=lambda: self.state_failures,
            certificate=lambda: None,
            files_refused=lambda: False,
            revocations=lambda: None,
            local_refused=lambda: {},
        )


def busy() -> Counters:
    counters = Counters()
    engine, link = counters.engine, counters.links[0]
    engine.requests.update({(PLAN, "ok"): 7, (PLAN, "deadline_missed"): 2})
    histogram = engine.durations.setdefault(PLAN, Histogram())
    for seconds in (0.0004, 0.012, 0.012, 0.09, 70.0):
        histogram.record(seconds)
    engine.wins[WLAN, CLOUD, PLAN] = 7
    engine.duplicate_responses = 5
    engine.called_off[WLAN, CLOUD, PLAN] = 6
    engine.explored[WLAN, CLOUD, PLAN] = 2
    engine.hedged[WLAN, CLOUD, PLAN] = 3
    engine.copy_bytes[WLAN, PLAN, "extra"] = 800
    engine.copies_refused[WLAN, PLAN, "day"] = 6
    engine.executions[PLAN, "run"] = 3
    engine.dropped["outbox_full"] = 1
    engine.late_dropped[PLAN] = 1
    engine.mapping_version = 1 << 60
    link.datagrams["sent", "data"] = 11
    link.dropped["malformed"] = 2
    link.bytes["received"] = 1200
    link.paths[CLOUD] = PathStats(up=True, srtt_s=0.025, datagrams_sent=11, datagrams_lost=1, bytes_sent=900)
    link.paths[NodeName("cloud-b")] = PathStats()
    counters.control.nacks[ResourceKind.MAPPING] = 1
    counters.control.ignored["undecodable"] = 1
    counters.bridge.requests_taken[PLAN] = 9
    counters.bridge.unanswered[PLAN, "failed"] = 1
    counters.bridge.fallbacks[PLAN, "won"] = 2
    counters.bridge.fallback_up = {PLAN: True}
    counters.bridge.fallback_takes_s = {PLAN: 0.25}
    counters.state_failures["write_failed"] = 4
    return counters


def exposition(counters: Counters) -> str:
    registry = CollectorRegistry()
    registry.register(SidecarCollector(counters.sources()))
    return generate_latest(registry).decode()


def samples(text: str) -> dict[str, float]:
    found = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            labels = ",".join(f"{name}={value}" for name, value in sorted(sample.labels.items()))
            found[f"{sample.name}{{{labels}}}"] = sample.value
    return found


def test_every_metric_of_the_contract_is_there_before_anything_happened() -> None:
    text = exposition(Counters())
    assert {name for name in CONTRACT if f"# TYPE {name} " in text} == CONTRACT


def test_counters_become_samples() -> None:
    found = samples(exposition(busy()))
    expected = {
        "plr_requests_total{outcome=failed,service=/plan}": 0,
        "plr_nacks_total{resource=peers}": 0,
        "plr_state_failures_total{reason=identity_refused}": 0,
        "plr_sidecar_info{name=robot-1,role=robot,version=0.1.0}": 1,
        "plr_requests_total{outcome=ok,service=/plan}": 7,
        "plr_requests_total{outcome=deadline_missed,service=/plan}": 2,
        "plr_fallback_requests_total{outcome=won,service=/plan}": 2,
        "plr_fallback_up{service=/plan}": 1,
        "plr_fallback_expected_seconds{service=/plan}": 0.25,
        "plr_path_wins_total{interface=wlan0,peer=cloud-a,service=/plan}": 7,
        "plr_duplicate_responses_total{}": 5,
        "plr_copies_called_off_total{interface=wlan0,peer=cloud-a,service=/plan}": 6,
        "plr_copies_explored_total{interface=wlan0,peer=cloud-a,service=/plan}": 2,
        "plr_copies_hedged_total{interface=wlan0,peer=cloud-a,service=/plan}": 3,
        "plr_copy_bytes_total{copy=extra,interface=wlan0,service=/plan}": 800,
        "plr_copies_refused_total{interface=wlan0,limit=day,service=/plan}": 6,
        "plr_executions_total{result=run,service=/plan}": 3,
        "plr_messages_dropped_total{reason=outbox_full}": 1,
        "plr_late_responses_dropped_total{service=/plan}": 1,
        "plr_mapping_version{}": float(1 << 60),
        "plr_interface_in_use{interface=wlan0}": 1,
        "plr_service_unmet{service=/where_i_am}": 1,
        "plr_interface_in_use{interface=wwan0}": 0,
        "plr_datagrams_total{direction=sent,interface=wlan0,kind=data}": 11,
        "plr_datagrams_dropped_total{interface=wlan0,reason=malformed}": 2,
        "plr_bytes_total{direction=received,interface=wlan0}": 1200,
        "plr_path_up{interface=wlan0,peer=cloud-a}": 1,
        "plr_path_up{interface=wlan0,peer=cloud-b}": 0,
        "plr_path_rtt_seconds{interface=wlan0,peer=cloud-a}": 0.025,
        "plr_path_datagrams_lost_total{interface=wlan0,peer=cloud-a}": 1,
        "plr_path_spurious_losses_total{interface=wlan0,peer=cloud-a}": 0,
        "plr_nacks_total{resource=mapping}": 1,
        "plr_control_plane_connected{}": 1,
        "plr_control_messages_ignored_total{reason=undecodable}": 1,
        "plr_bridge_messages_total{direction=request_from_application,service=/plan}": 9,
        "plr_bridge_unanswered_total{reason=failed,service=/plan}": 1,
        "plr_state_failures_total{reason=write_failed}": 4,
    }
    assert {name: found.get(name) for name in expected} == expected
    # A path never measured has no round-trip time, rather than one of zero.
    assert "plr_path_rtt_seconds{interface=wlan0,peer=cloud-b}" not in found


def test_durations_are_a_cumulative_histogram() -> None:
    found = samples(exposition(busy()))
    name = "plr_request_duration_seconds"
    assert found[f"{name}_bucket{{le=0.001,service=/plan}}"] == 1
    assert found[f"{name}_bucket{{le=0.01,service=/plan}}"] == 1
    assert found[f"{name}_bucket{{le=0.015,service=/plan}}"] == 3
    assert found[f"{name}_bucket{{le=0.1,service=/plan}}"] == 4
    assert found[f"{name}_bucket{{le=60.0,service=/plan}}"] == 4
    assert found[f"{name}_bucket{{le=+Inf,service=/plan}}"] == 5
    assert found[f"{name}_count{{service=/plan}}"] == 5
    # Beyond the last bucket the histogram knows a lower bound only: 60 s.
    assert found[f"{name}_sum{{service=/plan}}"] == pytest.approx(0.0004 + 0.024 + 0.09 + 60, rel=0.02)


@pytest.mark.parametrize("bound", DURATION_BOUNDS_S)
def test_a_duration_lands_at_its_bound_within_two_percent(bound: float) -> None:
    histogram = Histogram()
    histogram.record(bound * 0.979)
    histogram.record(bound * 1.021)
    buckets, _ = cumulative(histogram)
    counts = dict(buckets)
    assert counts[str(bound)] == 1
    assert counts["+Inf"] == 2


def test_a_scrape_while_counters_change_is_whole() -> None:
    counters = busy()
    stop = threading.Event()

    def count() -> None:
        number = 0
        while not stop.is_set():
            number += 1
            counters.engine.requests[ServiceName(f"/s{number % 997}"), "ok"] += 1
            counters.links[0].dropped[f"r{number % 499}"] += 1

    writer = threading.Thread(target=count)
    writer.start()
    try:
        for _ in range(30):
            exposition(counters)
    finally:
        stop.set()
        writer.join()


def scrape(server: MetricsServer, host: str = "127.0.0.1") -> str:
    with urllib.request.urlopen(f"http://{host}:{server.port}/metrics", timeout=20) as response:
        text: str = response.read().decode()
        return text


def test_serves_what_promtool_accepts_and_stops_cleanly() -> None:
    before = threading.active_count()
    server = serve_metrics("127.0.0.1:0", busy().sources())
    try:
        text = scrape(server)
    finally:
        server.close()
    assert "plr_requests_total" in text
    assert "process_cpu_seconds_total" in text
    checked = subprocess.run(["promtool", "check", "metrics"], input=text, capture_output=True, text=True, timeout=60)
    assert (checked.returncode, checked.stdout, checked.stderr) == (0, "", "")
    assert threading.active_count() == before
    with pytest.raises(OSError, match="refused"):
        scrape(server)


def test_listens_on_ipv6() -> None:
    server = serve_metrics("[::1]:0", busy().sources())
    try:
        assert "plr_requests_total" in scrape(server, "[::1]")
    finally:
        server.close()
