"""Tests that the loss shown for a path is that of the last minute."""

from __future__ import annotations

import pytest

from plr.sidecar.core.path.recent_loss import HALF_WINDOW_S, RecentLoss

EVERY_S = 0.25


class Counted:
    """A path that sends 100 datagrams a second."""

    def __init__(self) -> None:
        self.now, self.sent, self.lost = 0.0, 0.0, 0.0
        self.recent = RecentLoss(0.0)

    def run(self, seconds: float, loss: float) -> None:
        for _ in range(round(seconds / EVERY_S)):
            self.now += EVERY_S
            self.sent += 100 * EVERY_S
            self.lost += 100 * EVERY_S * loss
            self.recent.note(int(self.sent), int(self.lost), self.now)

    def loss(self) -> float:
        seen = self.recent.until(int(self.sent), int(self.lost), self.now)
        return seen.lost / seen.sent


def test_a_bad_minute_is_over_after_the_window() -> None:
    path = Counted()
    path.run(60.0, 0.5)
    assert path.loss() == pytest.approx(0.5, abs=0.01)
    path.run(2 * HALF_WINDOW_S, 0.0)
    assert path.loss() == 0.0


def test_a_path_that_became_bad_does_not_hide_behind_its_good_life() -> None:
    path = Counted()
    path.run(3600.0, 0.0)
    path.run(10.0, 0.5)
    assert path.loss() > 0.08


def test_the_window_is_told_and_never_longer_than_a_minute() -> None:
    path = Counted()
    for _ in range(400):
        path.run(1.0, 0.0)
        window_s = path.recent.until(int(path.sent), 0, path.now).window_s
        assert min(path.now, HALF_WINDOW_S) <= window_s <= 2 * HALF_WINDOW_S
        assert path.recent.until(int(path.sent), 0, path.now).sent == pytest.approx(100 * window_s, abs=1)


def test_what_came_before_a_pause_does_not_count() -> None:
    path = Counted()
    path.run(60.0, 0.5)
    path.now += 3600.0
    path.run(1.0, 0.0)
    seen = path.recent.until(int(path.sent), int(path.lost), path.now)
    assert (seen.lost, seen.window_s) == (0, 0.75)


def test_losses_that_prove_spurious_later_give_no_negative_count() -> None:
    recent = RecentLoss(0.0)
    recent.note(100, 50, 40.0)
    recent.note(200, 50, 80.0)
    seen = recent.until(210, 20, 81.0)
    assert (seen.sent, seen.lost) == (110, 0)
