"""Makes the sections' labs: a robot with two carriers and a server, over plain kernel cables or emulated links."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lab import HostSpec, InterfaceSpec, LabConfig, LabError, LinkProfile, server

if TYPE_CHECKING:
    from lab import Host, Lab

ROBOT = "robot"
CLOUDS = ("cloud_a", "cloud_b")
CLOUD = CLOUDS[0]
CARRIERS = ("wlan0", "wwan0")
CLOUD_INTERFACE = "eth0"
ETHERNET_MTU = 1500
_CORE = "internet"
_TABLE = "inet cut"


def cables() -> LabConfig:
    """Return a lab with nothing but the kernel between the hosts: veth pairs and a forwarding namespace.

    An emulator would add its own wake-ups, more than a call through us costs. There is no NAT, and routes go by source
    address: kernel multipath TCP, whose sockets are bound to addresses, needs both.
    """
    return _lab(tuple(InterfaceSpec(name, emulated=False, nat=None) for name in CARRIERS))


def emulated(*profiles: LinkProfile) -> LabConfig:
    """Return a lab with a carrier for each profile of delay, rate or losses, which holds for both directions."""
    return _lab(
        tuple(
            InterfaceSpec(name, nat=None, up=profile, down=profile)
            for name, profile in zip(CARRIERS, profiles, strict=False)
        )
    )


def ethernet_loopback(lab: Lab) -> Host:
    """Return a host whose loopback packets are no longer than Ethernet's, so that its speed applies to real networks.

    Raises LabError.
    """
    host = lab.host(ROBOT)
    host.ip_batch([f"link set lo mtu {ETHERNET_MTU}"])
    return host


def _lab(interfaces: tuple[InterfaceSpec, ...]) -> LabConfig:
    return LabConfig(
        robots=(HostSpec(ROBOT, interfaces),), clouds=tuple(server(name) for name in CLOUDS), source_routing=True
    )


def allow_multipath(robot: Host, cloud: Host) -> None:
    """Let the kernel's multipath TCP use the robot's second carrier; raises CalledProcessError if it has none."""
    for host in (robot, cloud):
        host.run(["ip", "mptcp", "limits", "set", "subflow", "2", "add_addr_accepted", "2"], check=True)
    robot.run(["ip", "mptcp", "endpoint", "flush"], check=True)
    second = robot.address(CARRIERS[1])
    robot.run(["ip", "mptcp", "endpoint", "add", second, "dev", CARRIERS[1], "subflow"], check=True)


class SilentCut:
    """Cuts cables in the middle: everything is lost both ways, while the carriers stay up and nobody is notified."""

    def __init__(self, lab: Lab) -> None:
        self._core = lab.host(_CORE)
        self._lab = lab

    def cut(self, *interfaces: str) -> None:
        """Lose all traffic from and to these interfaces of the robot; raises LabError."""
        ports = ", ".join(f'"to{self._number(name)}"' for name in interfaces)
        self._nft(
            f"table {_TABLE} {{\n"
            f" chain in {{ type filter hook prerouting priority -300; iifname {{ {ports} }} drop; }}\n"
            f" chain out {{ type filter hook postrouting priority 300; oifname {{ {ports} }} drop; }}\n"
            "}"
        )

    def mend(self) -> None:
        """End the cut; raises LabError."""
        self._nft(f"delete table {_TABLE}")

    def _number(self, interface: str) -> int:
        """Return the number that the lab gives an interface: the third byte of its network."""
        return int(self._lab.host(ROBOT).address(interface).split(".")[2])

    def _nft(self, rules: str) -> None:
        done = self._core.run(["nft", "-f", "-"], input=rules + "\n")
        if done.returncode:
            raise LabError(f"{_CORE}: {done.stderr.strip()}")
