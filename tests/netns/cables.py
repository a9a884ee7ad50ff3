"""Cables that are plugged into a lab's robot while it runs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lab import Host, Lab


def plug_in(lab: Lab, host: str, interface: str, *, network: int = 77) -> None:
    """Make `interface` on a host, cabled to the internet's router, with addresses of both families and routes."""
    internet = lab.host("internet")
    far = f"{interface}-far"
    machine = lab.host(host)
    machine.ip_batch([f"link add {interface} type veth peer name {far} netns {_pid_inside(internet)}"])
    internet.ip_batch(
        [
            f"link set {far} up",
            f"addr add 10.{network}.0.1/24 dev {far}",
            f"addr add fd00:{network}::1/64 dev {far} nodad",
        ]
    )
    machine.ip_batch(
        [
            f"link set {interface} up",
            f"addr add 10.{network}.0.2/24 dev {interface}",
            f"addr add fd00:{network}::2/64 dev {interface} nodad",
            f"route add default via 10.{network}.0.1 dev {interface} metric 900",
            f"route add default via fd00:{network}::1 dev {interface} metric 900",
        ]
    )


def pull_out(lab: Lab, host: str, interface: str) -> None:
    """The interface is gone, as a USB modem is."""
    lab.host(host).ip_batch([f"link del {interface}"])


def _pid_inside(host: Host) -> int:
    """PID of what holds the machine, as the lab's own programs see it."""
    for line in Path(f"/proc/{host.anchor_pid}/status").read_text().splitlines():
        if line.startswith("NSpid:"):
            return int(line.split()[-1])
    raise AssertionError("no NSpid in /proc")
