"""Derives what must be built from the topology: namespaces, segments between them, addresses, routes, rules.

Addresses: interface k (counted over all hosts, from 1) has the networks

    behind its NAT     192.168.k.0/24   fd00:168:0:k::/64   router .1 / ::1, host .2 / ::2
    to the internet    198.18.k.0/24    fd00:18:0:k::/64    core   .1 / ::1, router or host .2 / ::2

198.18.0.0/15 is set aside for benchmarks (RFC 2544), fd00::/8 for local use (RFC 4193). IPv6 is
routed end to end, without translation; the router's firewall is stateful for both.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

from lab.router import router_rules, router_sysctls

if TYPE_CHECKING:
    from lab.topology import HostSpec, InterfaceSpec, LabConfig

CORE = "internet"
# Distance between the metrics of two default routes, so that an experiment can insert one.
_METRIC_STEP = 100
_FIRST_SOURCE_TABLE = 1000

_COMMON_SYSCTLS = {
    "net/ipv4/conf/all/rp_filter": "0",
    "net/ipv4/conf/default/rp_filter": "0",
    "net/ipv6/conf/all/disable_ipv6": "0",
    "net/ipv6/conf/default/disable_ipv6": "0",
    "net/ipv6/conf/default/accept_ra": "0",
    "net/ipv6/conf/default/autoconf": "0",
    # Addresses are usable at once, without duplicate address detection.
    "net/ipv6/conf/all/accept_dad": "0",
    "net/ipv6/conf/default/accept_dad": "0",
}
_FORWARDING_SYSCTLS = {"net/ipv4/ip_forward": "1", "net/ipv6/conf/all/forwarding": "1"}
# Loopback as on a desktop, plus multicast, by which DDS discovers peers on the same host.
_LOOPBACK = ("link set lo up multicast on",)


@dataclass(frozen=True, slots=True)
class End:
    """One end of a segment."""

    namespace: str
    interface: str
    mac: str


@dataclass(frozen=True, slots=True)
class Segment:
    """A cable, or an emulated link, between two namespaces; `inner` is the host's end."""

    inner: End
    outer: End
    mtu: int
    link: int | None = None
    """Index into `Plan.links`; None for a plain cable."""


@dataclass(slots=True)
class Namespace:
    """A machine to build. `ip_lines` are commands of `ip -batch`."""

    name: str
    is_host: bool
    sysctls: dict[str, str]
    ip_lines: list[str] = field(default_factory=list)
    ip6_rules: list[str] = field(default_factory=list)
    """Commands of `ip -6 -batch`, since a rule does not name its family."""
    interface_lines: dict[str, list[str]] = field(default_factory=dict)
    """Interface -> the commands that address and route it, to be repeated after it was down."""
    nft_rules: str = ""


@dataclass(frozen=True, slots=True)
class LinkPlan:
    """An emulated link: the owner of its interface, its first profiles as JSON, its seed."""

    host: str
    interface: str
    up: dict[str, Any]
    down: dict[str, Any]
    seed: str


@dataclass(slots=True)
class Plan:
    """Everything to build; sent to the holder as JSON."""

    namespaces: dict[str, Namespace] = field(default_factory=dict)
    segments: list[Segment] = field(default_factory=list)
    links: list[LinkPlan] = field(default_factory=list)
    addresses: dict[str, dict[str, dict[int, str]]] = field(default_factory=dict)
    """Host or router -> interface -> 4 or 6 -> address."""
    gateways: dict[str, dict[str, str]] = field(default_factory=dict)
    """Host -> interface -> its NAT router's namespace."""
    hosts_file: str = ""
    ports: str = "auto"

    def to_json(self) -> dict[str, Any]:
        """Return the plan in a form ready for JSON."""
        return {
            "namespaces": {name: asdict(namespace) for name, namespace in self.namespaces.items()},
            "segments": [asdict(segment) for segment in self.segments],
            "links": [asdict(link) for link in self.links],
            "hosts_file": self.hosts_file,
            "ports": self.ports,
        }


def make_plan(config: LabConfig, seed: int) -> Plan:
    """Lay out the whole lab; a pure function."""
    plan = Plan(ports=config.ports)
    core = Namespace(CORE, False, {**_COMMON_SYSCTLS, **_FORWARDING_SYSCTLS}, list(_LOOPBACK))
    plan.namespaces[CORE] = core
    number = 0
    for host in config.hosts:
        plan.namespaces[host.name] = Namespace(host.name, True, dict(_COMMON_SYSCTLS), list(_LOOPBACK))
        for position, interface in enumerate(host.interfaces):
            number += 1
            _plan_interface(plan, config, host, interface, position, number, seed)
    plan.hosts_file = _hosts_file(plan, config)
    return plan


def _plan_interface(
    plan: Plan,
    config: LabConfig,
    host: HostSpec,
    interface: InterfaceSpec,
    position: int,
    number: int,
    seed: int,
) -> None:
    link = None
    if interface.emulated:
        link = len(plan.links)
        plan.links.append(
            LinkPlan(
                host=host.name,
                interface=interface.name,
                up=interface.up.to_json(),
                down=interface.down.to_json(),
                seed=f"{seed}/{host.name}/{interface.name}",
            )
        )
    core_end = End(CORE, f"to{number}", _mac(number, 0))
    core = plan.namespaces[CORE]
    if interface.nat is None:
        inner = End(host.name, interface.name, _mac(number, 1))
        plan.segments.append(Segment(inner, core_end, interface.mtu, link))
        _address(plan, inner, core_end, _wan(number, 2), 2)
        _address(plan, core_end, inner, _wan(number, 1), 1)
        gateway = _wan(number, 1)
    else:
        router_name = f"{host.name}-{interface.name}-nat"
        sysctls = {**_COMMON_SYSCTLS, **_FORWARDING_SYSCTLS, **router_sysctls(interface.nat)}
        router = Namespace(router_name, False, sysctls, list(_LOOPBACK), nft_rules=router_rules(interface.nat))
        plan.namespaces[router_name] = router
        plan.gateways.setdefault(host.name, {})[interface.name] = router_name
        wan = End(router_name, "wan0", _mac(number, 1))
        lan = End(router_name, "lan0", _mac(number, 2))
        inner = End(host.name, interface.name, _mac(number, 3))
        plan.segments.append(Segment(wan, core_end, 1500))
        plan.segments.append(Segment(inner, lan, interface.mtu, link))
        _address(plan, wan, core_end, _wan(number, 2), 2)
        _address(plan, core_end, wan, _wan(number, 1), 1)
        _address(plan, lan, inner, _lan(number, 1), 1)
        _address(plan, inner, lan, _lan(number, 2), 2)
        _default_routes(router.interface_lines["wan0"], "wan0", _wan(number, 1), _METRIC_STEP)
        core.interface_lines[core_end.interface].append(
            f"route replace fd00:168:0:{number:x}::/64 via {_wan(number, 2)[6]} dev {core_end.interface}"
        )
        gateway = _lan(number, 1)
    lines = plan.namespaces[host.name].interface_lines[interface.name]
    _default_routes(lines, interface.name, gateway, _METRIC_STEP * (position + 1))
    if config.source_routing:
        own = plan.addresses[host.name][interface.name]
        table = _FIRST_SOURCE_TABLE + position
        for family in (4, 6):
            lines.append(f"route replace default via {gateway[family]} dev {interface.name} table {table}")
            rules = plan.namespaces[host.name].ip_lines if family == 4 else plan.namespaces[host.name].ip6_rules
            rules.append(f"rule add from {own[family]} lookup {table}")


def _address(plan: Plan, end: End, peer: End, addresses: dict[int, str], own_number: int) -> None:
    """Give `end` its address and a fixed neighbour, so that no ARP has to cross a lossy link."""
    plan.addresses.setdefault(end.namespace, {})[end.interface] = addresses
    lines = plan.namespaces[end.namespace].interface_lines.setdefault(end.interface, [])
    lines += [
        f"link set {end.interface} up",
        f"addr replace {addresses[4]}/24 dev {end.interface}",
        f"addr replace {addresses[6]}/64 dev {end.interface} nodad",
    ]
    peer_number = 3 - own_number
    for address in addresses.values():
        neighbour = address[:-1] + str(peer_number)
        lines.append(f"neigh replace {neighbour} lladdr {peer.mac} dev {end.interface} nud permanent")


def _default_routes(lines: list[str], interface: str, gateway: dict[int, str], metric: int) -> None:
    lines += [f"route replace default via {gateway[f]} dev {interface} metric {metric}" for f in (4, 6)]


def _wan(number: int, own: int) -> dict[int, str]:
    return {4: f"198.18.{number}.{own}", 6: f"fd00:18:0:{number:x}::{own}"}


def _lan(number: int, own: int) -> dict[int, str]:
    return {4: f"192.168.{number}.{own}", 6: f"fd00:168:0:{number:x}::{own}"}


def _mac(number: int, end: int) -> str:
    return f"02:00:00:00:{number:02x}:{end:02x}"


def _hosts_file(plan: Plan, config: LabConfig) -> str:
    lines = ["127.0.0.1 localhost", "::1 localhost"]
    for host in config.hosts:
        if all(interface.nat is None for interface in host.interfaces):
            first = plan.addresses[host.name][host.interfaces[0].name]
            lines += [f"{first[family]} {host.name}" for family in (4, 6)]
    return "\n".join(lines) + "\n"
