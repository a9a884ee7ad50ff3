"""Describes the lab's topology as data: the hosts, their interfaces, and what lies behind each."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Literal

from lab.errors import LabConfigError
from lab.profile import LinkProfile

# An interface name has at most 15 bytes (IFNAMSIZ); host names become DNS labels and process names.
_INTERFACE_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_.-]{0,14}")
_HOST_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,30}")
# Interface k owns the third byte of an IPv4 network; 0 is left free.
MAX_INTERFACES = 200
MAX_ROBOT_INTERFACES = 4


@dataclass(frozen=True, slots=True)
class NatSpec:
    """A home or carrier router that translates IPv4, filters IPv6, and lets in nothing unsolicited."""

    kind: Literal["port-preserving", "symmetric"] = "port-preserving"
    """port-preserving: one mapping for all destinations, as STUN and hole punching need it (RFC 4787
    endpoint-independent mapping). symmetric: a different random port for every destination."""
    udp_timeout_s: int | None = None
    """Idle seconds after which a UDP mapping is forgotten; None means the kernel's 30 (120 once answered)."""

    def __post_init__(self) -> None:
        if self.udp_timeout_s is not None and self.udp_timeout_s < 1:
            raise LabConfigError(f"udp_timeout_s: expected >= 1, got {self.udp_timeout_s!r}")


@dataclass(frozen=True, slots=True)
class InterfaceSpec:
    """One interface of a host and what lies between it and the internet: link, then NAT router."""

    name: str
    emulated: bool = True
    """Whether an emulated link lies behind it, rather than a plain cable."""
    nat: NatSpec | None = field(default_factory=NatSpec)
    """The router behind the link; None if the interface has a public address."""
    up: LinkProfile = field(default_factory=LinkProfile)
    """The emulated link's first profile, host to internet."""
    down: LinkProfile = field(default_factory=LinkProfile)
    """The same, internet to host."""
    mtu: int = 1500
    """MTU in bytes of both ends of the first segment."""

    def __post_init__(self) -> None:
        if not _INTERFACE_NAME.fullmatch(self.name) or self.name == "lo":
            raise LabConfigError(f"interface name: expected 1..15 letters, digits, _ . -, got {self.name!r}")
        if not 1280 <= self.mtu <= 9000:
            raise LabConfigError(f"{self.name}: mtu: expected 1280..9000 (IPv6 needs 1280), got {self.mtu!r}")


@dataclass(frozen=True, slots=True)
class HostSpec:
    """A machine. Its first interface has the default route of the lowest metric."""

    name: str
    interfaces: tuple[InterfaceSpec, ...]

    def __post_init__(self) -> None:
        if not _HOST_NAME.fullmatch(self.name):
            raise LabConfigError(f"host name: expected a letter, then letters, digits, _ -, got {self.name!r}")
        names = [interface.name for interface in self.interfaces]
        if not names or len(set(names)) != len(names):
            raise LabConfigError(f"{self.name}: expected at least one interface, each name once, got {names}")


def server(name: str, *, delay_ms: float = 0.0) -> HostSpec:
    """Return a host on the internet: one public `eth0` on a plain cable, or `delay_ms` away (each way, emulated)."""
    far = LinkProfile(delay_ms=delay_ms)
    return HostSpec(name, (InterfaceSpec("eth0", emulated=delay_ms > 0, nat=None, up=far, down=far),))


def robot(name: str = "robot", interfaces: tuple[str, ...] = ("wlan0", "wwan0")) -> HostSpec:
    """Return a host whose interfaces each have their own emulated link and NAT router."""
    return HostSpec(name, tuple(InterfaceSpec(interface) for interface in interfaces))


@dataclass(frozen=True, slots=True)
class LabConfig:
    """The whole lab.

    Raises:
        LabConfigError: names are duplicate, or there are more interfaces than the address plan has room for.
    """

    robots: tuple[HostSpec, ...] = field(default_factory=lambda: (robot(),))
    clouds: tuple[HostSpec, ...] = field(default_factory=lambda: (server("cloud_a"), server("cloud_b")))
    control: HostSpec = field(default_factory=lambda: server("control"))
    source_routing: bool = False
    """Also route by source address, so that a socket bound only to an interface's address leaves through
    that interface. A robot out of the box does not; sockets bound to the device work either way."""
    ports: Literal["auto", "tap", "packet"] = "auto"
    """How the emulator gets its frames: TAP devices, packet sockets on veth pairs, or whichever is available."""

    def __post_init__(self) -> None:
        names = [host.name for host in self.hosts]
        if len(set(names)) != len(names):
            raise LabConfigError(f"host names: each once, got {names}")
        if not self.clouds:
            raise LabConfigError("clouds: expected at least one")
        for host in self.robots:
            if len(host.interfaces) > MAX_ROBOT_INTERFACES:
                raise LabConfigError(f"{host.name}: expected at most {MAX_ROBOT_INTERFACES} interfaces")
        if sum(len(host.interfaces) for host in self.hosts) > MAX_INTERFACES:
            raise LabConfigError(f"expected at most {MAX_INTERFACES} interfaces in all")

    @property
    def hosts(self) -> tuple[HostSpec, ...]:
        """Robots, clouds and the control host."""
        return (*self.robots, *self.clouds, self.control)

    @classmethod
    def of(cls, *, interfaces: tuple[str, ...] = ("wlan0", "wwan0"), clouds: int = 2, robots: int = 1) -> LabConfig:
        """Return a lab of robots robot, robot_2, ..., clouds cloud_a, cloud_b, ... and one control host."""
        if not 1 <= clouds <= 26:
            raise LabConfigError(f"clouds: expected 1..26, got {clouds}")
        return cls(
            robots=tuple(robot("robot" if n == 1 else f"robot_{n}", interfaces) for n in range(1, robots + 1)),
            clouds=tuple(server(f"cloud_{chr(ord('a') + n)}") for n in range(clouds)),
        )
