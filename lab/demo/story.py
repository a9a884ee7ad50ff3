"""Defines what happens in the demo, second by second."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from lab import LinkProfile

if TYPE_CHECKING:
    from collections.abc import Callable

WLAN = LinkProfile(delay_ms=8, jitter_ms=6, loss=0.005, rate_kbps=40_000)
"""Indoor Wi-Fi, in each direction; the delay is one-way."""
WWAN = LinkProfile(delay_ms=22, jitter_ms=8, loss=0.002, rate_kbps=20_000)
"""5G while driving."""


@dataclass(frozen=True, slots=True)
class Phase:
    """A period of the demo under one trouble; `weight` is its share of the whole."""

    name: str
    weight: float
    begin: Callable[[Stage], None]
    shade: str = "#ffffff"


class Stage:
    """What the phases may do to the running system."""

    def blackhole(self, interface: str) -> None:
        """Lose all datagrams of this carrier; its interface stays up."""
        raise NotImplementedError

    def restore(self, interface: str) -> None:
        """Bring the carrier back."""
        raise NotImplementedError

    def kill_cloud(self) -> None:
        """Send SIGKILL to the second cloud's ROS server and sidecar."""
        raise NotImplementedError

    def start_cloud(self) -> None:
        """Bring the second cloud back."""
        raise NotImplementedError

    def kill_control_plane(self) -> None:
        """Send SIGKILL to the control plane."""
        raise NotImplementedError

    def start_control_plane(self) -> None:
        """Bring the control plane back."""
        raise NotImplementedError


def _nothing(stage: Stage) -> None:
    """Do nothing: both links are good."""


def _wlan_dark(stage: Stage) -> None:
    stage.blackhole("wlan0")


def _wlan_back(stage: Stage) -> None:
    stage.restore("wlan0")


def _wwan_dark(stage: Stage) -> None:
    stage.blackhole("wwan0")


def _wwan_back(stage: Stage) -> None:
    stage.restore("wwan0")


def _cloud_killed(stage: Stage) -> None:
    stage.kill_cloud()


def _control_killed(stage: Stage) -> None:
    stage.start_cloud()
    stage.kill_control_plane()


def _control_back(stage: Stage) -> None:
    stage.start_control_plane()


PHASES = (
    Phase("both links good", 8, _nothing),
    Phase("wlan0 dark", 10, _wlan_dark, "#d8d8e8"),
    Phase("both links good", 5, _wlan_back),
    Phase("wwan0 dark", 10, _wwan_dark, "#e8d8d8"),
    Phase("both links good", 5, _wwan_back),
    Phase("cloud_b killed -9", 9, _cloud_killed, "#f4e3c4"),
    Phase("control plane killed -9", 8, _control_killed, "#dcecd8"),
    Phase("control plane back", 5, _control_back),
)
"""The phases, a minute at the default length. A rest follows each dark phase: then the robot with only that carrier
hands its backlog to the servers that all three share."""
