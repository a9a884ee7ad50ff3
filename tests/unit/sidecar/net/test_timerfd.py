from __future__ import annotations

import select
import threading
import time

import pytest

from plr.sidecar.core.base.timers import NEVER
from plr.sidecar.net.timerfd import Timer

PATIENCE_S = 20.0


def fired(timer: Timer, timeout_s: float = PATIENCE_S) -> bool:
    return bool(select.select([timer.fd], [], [], timeout_s)[0])


@pytest.mark.parametrize("delay_s", [0.0, 0.0002, 0.003, 0.02])
def test_it_fires_when_due_and_not_before(delay_s: float) -> None:
    timer = Timer()
    due = time.monotonic() + delay_s
    timer.arm(due)
    assert timer.due == due
    timer.wait()
    assert time.monotonic() >= due
    assert timer.due == NEVER


@pytest.mark.parametrize("due", [-1.0, 0.0, 1e-12])
def test_what_is_past_fires_at_once(due: float) -> None:
    timer = Timer()
    timer.arm(due)
    assert fired(timer)


@pytest.mark.parametrize("due", [1e9, 1e300, NEVER])
def test_a_time_far_away_is_kept(due: float) -> None:
    timer = Timer()
    timer.arm(due)
    assert not fired(timer, 0.0)


def test_arming_at_latest_moves_it_only_earlier() -> None:
    timer = Timer()
    far = time.monotonic() + 3600.0
    timer.arm_at_latest(far)
    timer.arm_at_latest(far + 1.0)
    assert timer.due == far
    timer.arm_at_latest(0.0)
    assert fired(timer)


def test_arming_again_forgets_the_time_before() -> None:
    timer = Timer()
    timer.arm(0.0)
    timer.arm(time.monotonic() + 3600.0)
    assert not fired(timer, 0.0)


def test_another_thread_may_arm_it_while_one_waits() -> None:
    timer = Timer()
    timer.arm(time.monotonic() + 3600.0)
    waiting = threading.Thread(target=timer.wait, daemon=True)
    waiting.start()
    timer.arm_at_latest(0.0)
    waiting.join(PATIENCE_S)
    assert not waiting.is_alive()
