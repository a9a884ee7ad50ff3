"""Lists the host's network interfaces by netlink, and chooses which of them carry data.

Netlink is used rather than /sys: it answers for the network namespace of the caller, while /sys shows the one it
was mounted in, and it alone knows the kind of a link.
"""

from __future__ import annotations

import fnmatch
import socket
from dataclasses import dataclass
from ipaddress import ip_address
from typing import TYPE_CHECKING, Any

from pyroute2 import IPRoute, NetlinkError

from plr.protos.model.ids import InterfaceName
from plr.sidecar.config.fields import is_glob
from plr.sidecar.core.seam.links import Rebind

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
"""`Interface.kind` of lo, for which netlink has none."""

_ORDINARY_KINDS = frozenset({"", "bond", "team", "vlan", "wwan", "rmnet", "ppp"})
"""Kinds of link that lead out of the machine: hardware (no kind), bundles or parts of it, and modems."""

_CONTAINER_AND_TUNNEL_NAMES = (
    "docker*", "br-*", "veth*", "virbr*", "vnet*", "lxc*", "lxdbr*", "podman*", "cni*", "cali*", "flannel*",
    "cilium*", "kube-*", "tun*", "tap*", "wg*", "tailscale*", "zt*", "utun*",
)  # fmt: skip
"""Names of containers' interfaces and tunnels, for kernels and drivers that report no kind."""


@dataclass(frozen=True, slots=True)
class Interface:
    """One interface at one moment."""

    name: InterfaceName
    index: int
    kind: str
    """Netlink's kind (veth, bridge, wireguard, ...), LOOPBACK, or "" for hardware."""
    up: bool
    """Whether the administrator has switched it on."""
    carrier: bool
    """Whether the cable is in, or the access point or cell is joined."""
    mtu: int
    addresses: tuple[str, ...] = ()
    """IPv4 and IPv6 addresses of global or unique-local scope, in canonical form; no link-local ones."""
    gateways: tuple[tuple[int, str], ...] = ()
    """The default routes of all tables over this interface, sorted: the family that they carry (4, 6), and the next
    hop, "" for a link that needs none."""

    @property
    def families(self) -> frozenset[int]:
        """Return the families of its addresses: 4, 6, both or none."""
        return frozenset(6 if ":" in address else 4 for address in self.addresses)

    def rebound_since(self, before: Interface) -> Rebind | None:
        """Return what is gone of the ways out it had `before`; None when addresses and gateways are the same.

        An additional address alone takes nothing away.
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
    """Whether it would be used if it could carry anything now."""


@dataclass(frozen=True, slots=True)
class InterfaceChoice:
    """The result of `choose`."""

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

    Loopback, containers, bridges and tunnels are used only by their exact name: neither the default nor a glob
    includes them. An interface that is wanted but is not up, has no carrier or no address is skipped.
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
    """Return a readable line about each interface that is missing: a modem comes late, or a name is wrong.

    `wanted` as in `choose`; `described`: names and globs of interfaces that the configuration describes.
    """
    names = [interface.name for interface in interfaces]
    there = ", ".join(names)
    missing = choose(interfaces, wanted).missing
    lines = [
        f"{name}: there is no such interface now (there are: {there}); it is used as soon as it appears"
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
        return "container or tunnel, by its name"
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
    """Return the gateway of a route or of one of its hops; RTA_VIA is a gateway of the other family."""
    via = route.get("gateway") or (route.get("via") or {}).get("addr") or ""
    return str(via)
