"""The host's network interfaces as netlink tells them, and which of them carry data.

Netlink rather than /sys: it answers for the network namespace of the caller, while /sys shows the one it was
mounted in, and it alone knows the kind of a link.
"""

from __future__ import annotations

import fnmatch
import socket
from dataclasses import dataclass
from ipaddress import ip_address
from typing import TYPE_CHECKING, Any

from pyroute2 import IPRoute, NetlinkError

from protos.model.ids import InterfaceName
from sidecar.config.fields import is_glob
from sidecar.core.seam.links import Rebind

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

_IFF_UP = 0x1
_IFF_LOOPBACK = 0x8
_IFF_LOWER_UP = 0x10000
_SCOPE_LINK = 253
_RTN_UNICAST = 1
_IFA_F_DADFAILED = 0x08
_IFA_F_DEPRECATED = 0x20
_IFA_F_TENTATIVE = 0x40
_UNUSABLE_ADDRESS = _IFA_F_DADFAILED | _IFA_F_DEPRECATED | _IFA_F_TENTATIVE

LOOPBACK = "loopback"
"""`Interface.kind` of lo, which netlink gives none."""

_ORDINARY_KINDS = frozenset({"", "bond", "team", "vlan", "wwan", "rmnet", "ppp"})
"""Kinds of link that lead out of the machine: hardware (no kind), what bundles or splits it, and modems."""

_CONTAINER_AND_TUNNEL_NAMES = (
    "docker*", "br-*", "veth*", "virbr*", "vnet*", "lxc*", "lxdbr*", "podman*", "cni*", "cali*", "flannel*",
    "cilium*", "kube-*", "tun*", "tap*", "wg*", "tailscale*", "zt*", "utun*",
)  # fmt: skip
"""Names of the same things, for kernels and drivers that tell no kind."""


@dataclass(frozen=True, slots=True)
class Interface:
    """One interface at one moment."""

    name: InterfaceName
    index: int
    kind: str
    """Netlink's kind (veth, bridge, wireguard, ...), LOOPBACK, or "" for hardware."""
    up: bool
    """Switched on by the administrator."""
    carrier: bool
    """The cable is in, the access point or cell is joined."""
    mtu: int
    addresses: tuple[str, ...] = ()
    """IPv4 and IPv6 of global or unique-local scope, in canonical form; no link-local ones."""
    gateways: tuple[tuple[int, str], ...] = ()
    """Where the default routes that leave by it lead, of all tables, sorted: the family that they carry (4, 6), and the
    next hop, "" for a link that needs none."""

    @property
    def families(self) -> frozenset[int]:
        """4, 6, both or none: of its addresses."""
        return frozenset(6 if ":" in address else 4 for address in self.addresses)

    def rebound_since(self, before: Interface) -> Rebind | None:
        """Return what of the ways out that it had `before` is no more; None when addresses and gateways are the same.

        A further address alone takes nothing away.
        """
        rerouted = {family for family, _ in set(self.gateways) ^ set(before.gateways)}
        if not rerouted and set(self.addresses) == set(before.addresses):
            return None
        return Rebind(frozenset(before.addresses).difference(self.addresses), frozenset(rerouted))


@dataclass(frozen=True, slots=True)
class SkippedInterface:
    """An interface that is there but not used."""

    name: InterfaceName
    index: int
    reason: str
    wanted: bool
    """It would be used if it could carry anything now."""


@dataclass(frozen=True, slots=True)
class InterfaceChoice:
    """What `choose` found."""

    usable: tuple[Interface, ...]
    skipped: tuple[SkippedInterface, ...]
    missing: tuple[str, ...]
    """Names (not globs) that were wanted and do not exist."""


def list_interfaces() -> tuple[Interface, ...]:
    """Return the interfaces of the caller's network namespace by index; raises OSError when netlink fails."""
    try:
        with IPRoute() as netlink:
            addresses = _addresses_by_index(netlink.get_addr())
            gateways = _gateways_by_index(netlink.get_routes())
            interfaces = [_interface(link, addresses, gateways) for link in netlink.get_links()]
    except NetlinkError as error:
        raise OSError(error.code, str(error)) from error
    return tuple(sorted(interfaces, key=lambda interface: interface.index))


def choose(interfaces: Iterable[Interface], wanted: Sequence[str] | None) -> InterfaceChoice:
    """Pick the interfaces that carry data: all ordinary ones, or those that `wanted` names or matches.

    Loopback, containers, bridges and tunnels are used only under their exact name: neither the default nor a
    glob brings them in. An interface that is wanted but not up, without carrier or without address is skipped.
    """
    usable: list[Interface] = []
    skipped: list[SkippedInterface] = []
    names = set()
    for interface in interfaces:
        names.add(interface.name)
        unwanted = _reason_not_to_want(interface, wanted)
        reason = unwanted or _reason_not_to_use(interface)
        if reason is None:
            usable.append(interface)
        else:
            skipped.append(SkippedInterface(interface.name, interface.index, reason, wanted=unwanted is None))
    missing = tuple(name for name in wanted or () if not is_glob(name) and name not in names)
    return InterfaceChoice(tuple(usable), tuple(skipped), missing)


def missing_interfaces(
    interfaces: Sequence[Interface], wanted: Sequence[str] | None, described: Sequence[str] = ()
) -> list[str]:
    """Return a line for a person about each interface that is not there: a modem comes late, a name is wrong.

    `wanted` as in `choose`; `described`: names and globs of interfaces of which the configuration says something.
    """
    names = [interface.name for interface in interfaces]
    there = ", ".join(names)
    missing = choose(interfaces, wanted).missing
    lines = [
        f"{name}: there is no such interface now (there are: {there}); it is used as soon as it comes"
        for name in missing
    ]
    return lines + [
        f"networks: {pattern} matches no interface now (there are: {there})"
        for pattern in described
        if pattern not in missing and not fnmatch.filter(names, pattern)
    ]


def _reason_not_to_want(interface: Interface, wanted: Sequence[str] | None) -> str | None:
    name = interface.name
    if wanted is not None and not any(fnmatch.fnmatchcase(name, pattern) for pattern in wanted):
        return "not in the configuration"
    if wanted is None or name not in wanted:
        kind = _virtual_kind(interface)
        if kind is not None:
            return f"{kind}: used only when the configuration has its exact name"
    return None


def _reason_not_to_use(interface: Interface) -> str | None:
    if not interface.up:
        return "down"
    if not interface.carrier:
        return "no carrier"
    if not interface.addresses:
        return "no address"
    return None


def _virtual_kind(interface: Interface) -> str | None:
    if interface.kind not in _ORDINARY_KINDS:
        return interface.kind
    if any(fnmatch.fnmatchcase(interface.name, pattern) for pattern in _CONTAINER_AND_TUNNEL_NAMES):
        return "container or tunnel by its name"
    return None


def _interface(link: Any, addresses: dict[int, list[str]], gateways: dict[int, set[tuple[int, str]]]) -> Interface:
    flags = link["flags"]
    index = link["index"]
    kind = LOOPBACK if flags & _IFF_LOOPBACK else link.get(("linkinfo", "kind")) or ""
    return Interface(
        name=InterfaceName(link.get("ifname")),
        index=index,
        kind=kind,
        up=bool(flags & _IFF_UP),
        carrier=bool(flags & _IFF_LOWER_UP),
        mtu=link.get("mtu") or 0,
        addresses=tuple(addresses.get(index, ())),
        gateways=tuple(sorted(gateways.get(index, ()))),
    )


def _addresses_by_index(messages: Iterable[Any]) -> dict[int, list[str]]:
    addresses: dict[int, list[str]] = {}
    for message in messages:
        # On point-to-point links IFA_ADDRESS is the far end; IFA_LOCAL, where it exists, is ours.
        text = message.get("local") or message.get("address")
        flags = message.get("flags") or 0
        if text is None or flags & _UNUSABLE_ADDRESS or message["scope"] == _SCOPE_LINK:
            continue
        address = ip_address(text)
        if not address.is_link_local:
            addresses.setdefault(message["index"], []).append(str(address))
    return addresses


def _gateways_by_index(messages: Iterable[Any]) -> dict[int, set[tuple[int, str]]]:
    gateways: dict[int, set[tuple[int, str]]] = {}
    for message in messages:
        unicast = message["type"] == _RTN_UNICAST and message["family"] in (socket.AF_INET, socket.AF_INET6)
        if not unicast or message["dst_len"] != 0:
            continue
        family = 6 if message["family"] == socket.AF_INET6 else 4
        if message.get("oif") is not None:
            gateways.setdefault(message.get("oif"), set()).add((family, _next_hop(message)))
        for hop in message.get("multipath") or ():
            gateways.setdefault(hop["oif"], set()).add((family, _next_hop(hop)))
    return gateways


def _next_hop(route: Any) -> str:
    """The gateway of a route or of one of its hops; RTA_VIA is one of the other family."""
    via = route.get("gateway") or (route.get("via") or {}).get("addr") or ""
    return str(via)
