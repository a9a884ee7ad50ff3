"""How often one source is answered, and what a flood of sources costs."""

from __future__ import annotations

from plr.controlplane.core.stun.source_limits import (
    ANSWERS_BURST,
    ANSWERS_PER_S,
    MAX_SOURCES,
    UNLISTED_ANSWERS_PER_S,
    SourceLimits,
)

NOW = 100.0


def answers(limits: SourceLimits, ip: str, times: int, now: float = NOW) -> int:
    return sum(limits.allows((ip, 4000), now) for _ in range(times))


def v4(number: int) -> str:
    return f"10.{number >> 16 & 255}.{number >> 8 & 255}.{number & 255}"


def test_a_burst_and_then_a_rate() -> None:
    limits = SourceLimits(NOW)
    assert answers(limits, "192.0.2.1", 1000) == ANSWERS_BURST
    assert answers(limits, "192.0.2.1", 1000, NOW + 1.0) == ANSWERS_PER_S
    assert answers(limits, "192.0.2.2", 1) == 1


def test_another_port_is_the_same_source() -> None:
    limits = SourceLimits(NOW)
    allowed = sum(limits.allows(("192.0.2.1", port), NOW) for port in range(1, 1001))
    assert allowed == ANSWERS_BURST


def test_an_ipv6_subscriber_is_one_source_whatever_address_it_takes() -> None:
    limits = SourceLimits(NOW)
    allowed = sum(limits.allows((f"2001:db8:0:1::{number:x}", 4000), NOW) for number in range(1000))
    assert allowed == ANSWERS_BURST
    assert answers(limits, "2001:db8:0:2::1", 1) == 1


def test_the_table_is_bounded_and_idle_sources_make_room() -> None:
    limits = SourceLimits(NOW)
    for number in range(MAX_SOURCES):
        assert limits.allows((v4(number), 4000), NOW)
    later = NOW + ANSWERS_BURST / ANSWERS_PER_S
    for number in range(MAX_SOURCES, 2 * MAX_SOURCES):
        assert limits.allows((v4(number), 4000), later)
    assert len(limits) == MAX_SOURCES


def test_a_flood_of_forged_sources_frees_nobody_from_its_limit() -> None:
    """Who is held back stays so, and those without a place share one limit."""
    limits = SourceLimits(NOW)
    victim = "192.0.2.1"
    assert answers(limits, victim, 1000) == ANSWERS_BURST
    flood = sum(limits.allows((v4(number), 4000), NOW) for number in range(4 * MAX_SOURCES))
    assert flood == MAX_SOURCES - 1 + UNLISTED_ANSWERS_PER_S
    assert len(limits) == MAX_SOURCES
    assert answers(limits, victim, 1) == 0
