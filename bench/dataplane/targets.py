"""Defines the targets of the data plane's figures."""

from __future__ import annotations

from bench.reporting.targets import Target

RTT_MS = 50.0
"""Round trip of the links in the section `loss`."""

TARGETS = (
    Target("engine_150k_over_aioquic", "one-way time of 150 kB on loopback, ours over aioquic's", at_most=0.25),
    Target(
        "goodput_mbit_s",
        "goodput of one path on loopback, Mbit/s",
        at_least=800,
        or_key="goodput_over_aioquic",
        or_at_least=5,
    ),
    Target(
        "ethernet_150k_over_aioquic", "the same with packets of 1500 bytes, as real networks carry them", at_most=0.25
    ),
    Target(
        "ethernet_goodput_mbit_s",
        "the goodput with packets of 1500 bytes",
        at_least=800,
        or_key="ethernet_goodput_over_aioquic",
        or_at_least=5,
    ),
    Target("sealed_over_null_goodput", "goodput of one path on loopback over that with a null cipher", at_least=0.65),
    Target("ethernet_sealed_over_null_goodput", "the same with packets of 1500 bytes", at_least=0.65),
    Target("proxied_over_direct_1k", "median ROS call of 1 kB through two sidecars over the direct call", at_most=5),
    Target("proxied_over_direct_150k", "the same with 150 kB", at_most=7),
    Target("blackhole_lost", "requests lost after one of two paths went silent", at_most=0),
    Target("blackhole_p99_ms", "P99 of the requests after it", at_most=3),
    Target("blackhole_mptcp_worst_over_ours", "worst of the kernel's multipath TCP over our worst", at_least=20),
    Target("fec_p99_over_lossfree_2pct", "2 % loss, FEC auto: P99 over that without loss", at_most=1.15),
    Target(
        "arq_p99_minus_lossfree_ms_2pct",
        "2 % loss, no FEC: P99 above that without loss, ms (one round trip and 20 ms)",
        at_most=RTT_MS + 20,
    ),
    Target("loss_lost", "requests lost in all runs with losses", at_most=0),
    Target(
        "overload_p99_over_undisturbed",
        "P99 over the good path while the other is overloaded, over that while it is not",
        at_most=1.1,
    ),
    Target("overload_memory_growth_mb", "resident memory that the overload added to the robot's side", at_most=32),
    Target(
        "outage_first_after_up_over_lossfree_p99",
        "first request submitted once a path is seen to be up again after 2 to 10 s without, over the P99 before",
        at_most=1.25,
    ),
    Target("flood_lost", "requests lost while 20000 junk datagrams a second come", at_most=0),
    Target(
        "flood_p99_over_allowed",
        "P99 meanwhile, over what is allowed: 5 ms more than undisturbed, or twice as much",
        at_most=1,
    ),
    Target(
        "keys_p99_renewed_over_kept",
        "P99 of 1 kB with keys renewed every second (120 times as often as by default), over that with keys kept",
        at_most=1.15,
    ),
    Target("keys_goodput_renewed_over_kept", "goodput likewise", at_least=0.95),
    Target("keys_lost", "requests lost in both", at_most=0),
    Target("tcp_share_ratio", "goodput of one TCP flow over ours at one bottleneck", at_least=0.25, at_most=4),
)
