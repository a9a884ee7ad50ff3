"""Shares one bottleneck between a TCP flow (iperf3) and our bulk messages: neither may starve the other.

It has 20 Mbit/s, 40 ms round trip, and a queue of one bandwidth-delay product. Our messages run before the TCP flow
begins and after it ends; both goodputs are measured during the TCP flow.
"""

from __future__ import annotations

import json
import statistics
import time
from typing import TYPE_CHECKING

from bench.dataplane.ours import EVERY_CARRIER, SERVICE, Ours
from bench.dataplane.section import Findings, Plot, Section
from bench.dataplane.statistics import interval, median, ratio
from bench.dataplane.topology import CARRIERS, CLOUD, ROBOT, emulated
from bench.reporting.tables import Table
from lab import Lab, LinkProfile

if TYPE_CHECKING:
    from collections.abc import Sequence

    from bench.dataplane.section import Context

RATE_KBPS = 20_000
ONE_WAY_MS = 20.0
LINK = LinkProfile(delay_ms=ONE_WAY_MS, rate_kbps=RATE_KBPS, queue_bytes=round(RATE_KBPS / 8 * 2 * ONE_WAY_MS))
SIZE = 100_000
AT_ONCE = 6
"""Messages in flight: 600 kB are three times what link and queue hold."""
FLOW_S = 10
QUICK_FLOW_S = 4
BLOCK_S = 3
"""Consecutive seconds drawn together for the interval: TCP's growing and halving spans several."""
LEAD_S = 2.0
"""Time of our messages alone before the TCP flow."""
CUBIC = ("-C", "cubic")
"""Congestion control of most senders on the internet (RFC 9438), whatever this kernel's default is."""
PATIENT = {**SERVICE, "deadline_ms": 10_000.0, "lifetime_ms": 60_000.0}


def measure(context: Context) -> Findings:
    """Measure."""
    flow_s = QUICK_FLOW_S if context.quick else FLOW_S
    tcp: list[float | None] = []
    ours_mbit: list[float] = []
    alone: list[float | None] = []
    seconds_of_tcp: list[float] = []
    seconds_of_ours: list[float] = []
    with (
        Lab(emulated(LINK)) as lab,
        Ours.in_lab(lab, context.folder, mapping=EVERY_CARRIER[:1], service=PATIENT) as ours,
    ):
        robot, cloud = lab.host(ROBOT), lab.host(CLOUD)
        server = cloud.popen(["iperf3", "-s"], log_path=context.folder / "iperf3.log")
        for repeat in range(context.repeats):
            context.say(f"share: {repeat + 1} of {context.repeats}")
            seconds = flow_s + 2 * LEAD_S
            start = time.monotonic()
            ours.begin(size=SIZE, count=100_000, at_once=AT_ONCE, seconds=seconds, grace_s=10.0)
            time.sleep(LEAD_S)
            flow_start = time.monotonic()
            argv = ["iperf3", "-c", cloud.address(), "-B", robot.address(CARRIERS[0]), "-t", str(flow_s)]
            flow = json.loads(robot.run([*argv, *CUBIC, "-J"], timeout=flow_s + 20).stdout)
            flow_end = time.monotonic()
            calls = ours.finish()
            tcp.append(flow["end"]["sum_received"]["bits_per_second"] / 1e6 if "end" in flow else None)
            arrivals = calls.arrivals()
            ours_mbit.append(_rate(arrivals, flow_start, flow_end))
            seconds_of_tcp += (one["sum"]["bits_per_second"] / 1e6 for one in flow.get("intervals", ()))
            seconds_of_ours += (_rate(arrivals, flow_start + at, flow_start + at + 1.0) for at in range(flow_s))
            alone.append(_rate(arrivals, start + LEAD_S / 2, flow_start))
        cloud.kill(server)
    figures = {
        "tcp_mbit_s": median(tcp),
        "ours_beside_tcp_mbit_s": median(ours_mbit),
        "ours_alone_mbit_s": median(alone),
        "tcp_share_ratio": _mean_ratio([rate for rate in tcp if rate is not None], ours_mbit),
        "tcp_share_ratio_of_repeats": median(ratio(one, other) for one, other in zip(tcp, ours_mbit, strict=True)),
    }
    rows = (
        ("TCP (CUBIC)", figures["tcp_mbit_s"]),
        ("ours beside it", figures["ours_beside_tcp_mbit_s"]),
        ("ours before it", figures["ours_alone_mbit_s"]),
    )
    return Findings(
        figures=dict(figures),
        intervals={"tcp_share_ratio": interval(_mean_ratio, seconds_of_tcp, seconds_of_ours, block=BLOCK_S)},
        tables=[Table("20 Mbit/s, 40 ms, queue of one bandwidth-delay product", ("", "Mbit/s"), rows)],
        plots=[Plot("sharing 20 Mbit/s", "", "Mbit/s", bars=dict(rows))],
    )


def _mean_ratio(tcp: Sequence[float], ours: Sequence[float]) -> float | None:
    return ratio(statistics.fmean(tcp), statistics.fmean(ours)) if tcp and ours else None


def _rate(arrivals: list[float], start: float, end: float) -> float:
    """Return the Mbit/s of the messages answered in this period."""
    return sum(start <= at < end for at in arrivals) * SIZE * 8 / 1e6 / (end - start)


SECTION = Section("share", "A bottleneck shared with TCP", measure)
