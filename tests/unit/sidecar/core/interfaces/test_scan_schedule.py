from __future__ import annotations

import pytest

from plr.sidecar.core.interfaces.scan_schedule import (
    BUSY_FACTOR,
    DEBOUNCE_S,
    MAX_GAP_S,
    MIN_GAP_S,
    RETRY_S,
    SAFETY_NET_S,
    WITHOUT_NEWS_S,
    ScanSchedule,
)


def scanned(at: float = 100.0, took: float = 0.005, *, has_news: bool = True) -> ScanSchedule:
    schedule = ScanSchedule(at - took, has_news=has_news)
    schedule.scanned(at - took, at)
    return schedule


def test_the_first_scan_is_due_at_once() -> None:
    assert ScanSchedule(5.0, has_news=True).due == 5.0


@pytest.mark.parametrize(("has_news", "every_s"), [(True, SAFETY_NET_S), (False, WITHOUT_NEWS_S)])
def test_without_changes_it_is_rare(has_news: bool, every_s: float) -> None:
    assert scanned(has_news=has_news).due == 100.0 + every_s


def test_a_change_is_acted_on_after_the_debounce_time_however_many_follow() -> None:
    schedule = scanned()
    for step in range(10):
        schedule.changed(103.0 + step * DEBOUNCE_S / 2)
    assert schedule.due == 103.0 + DEBOUNCE_S


def test_a_flood_of_changes_costs_a_bounded_share_of_time() -> None:
    """A change every millisecond for 100 s, scans of 5 and of 100 ms."""
    for took in (0.005, 0.1):
        schedule = ScanSchedule(0.0, has_news=True)
        now, scans = 0.0, 0
        while now < 100.0:
            schedule.changed(now)
            if schedule.due <= now:
                scans += 1
                schedule.scanned(now, now + took)
                now += took
            now += 0.001
        assert scans * took <= 100.0 / BUSY_FACTOR + took
        assert scans <= 100.0 / MIN_GAP_S + 1


def test_a_scan_that_takes_for_ever_does_not_put_off_the_next_one_for_ever() -> None:
    schedule = scanned(took=60.0)
    schedule.changed(100.0)
    assert schedule.due == 100.0 + MAX_GAP_S


def test_a_failed_scan_is_repeated_and_changes_meanwhile_do_not_hasten_it() -> None:
    schedule = scanned()
    schedule.failed(101.0)
    schedule.changed(101.0)
    assert schedule.due == 101.0 + RETRY_S
