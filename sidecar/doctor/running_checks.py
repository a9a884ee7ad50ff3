"""Judges a running sidecar's state: STUN, MTU, paths, mapping, control stream. Pure.

`LocalClient.state` returns a state. It may come from a sidecar of another version: missing parts are left out.
"""

from __future__ import annotations

import errno
import os
from dataclasses import dataclass, field
from ipaddress import ip_address, ip_network
from typing import TYPE_CHECKING, Any

from plr.sidecar.core.path.pmtu import HEADERS_V4, HEADERS_V6, LEAST_MTU
from plr.sidecar.core.wire.frame import BASE_BYTES
from plr.sidecar.doctor import losses, removed_peers
from plr.sidecar.doctor.finding import duration, fail, milliseconds, ok, share, warn

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from plr.sidecar.doctor.finding import Finding

State = dict[str, Any]

STUN_FRESH_S = 60.0
"""STUN asks for a mapping about every 15 s; if it is older than this, several answers in a row are missing."""
SEARCHED_S = 60.0
"""The search for a path's MTU is over after this long."""
STARTED_S = 20.0
"""Peers are known and probed within this time after the start."""
MAX_SHOWN_GONE = 8
"""Lines about nodes that are no longer peers."""
MAX_SHOWN_CONFLICTS = 3
"""Servers named that offer a service with another type."""
MAX_SHOWN_STUN = 3
"""STUN servers named in a remedy."""
GOODBYE = "peer closed"
"""Reason for a path going down when its node ended in order."""
HOPELESS = 0.5
"""Predicted misses above which a service without a target gets a warning."""
SHARED_ADDRESSES = ip_network("100.64.0.0/10")
"""RFC 6598: addresses behind a carrier's NAT."""


@dataclass(slots=True)
class Pinged:
    """Results of the pings over one path."""

    rtts_s: list[float] = field(default_factory=list)
    sent: int = 0
    """Number of pings that left, as far as is known."""
    problem: str = ""
    """Why the last one did not leave."""

    def take(self, rtt_s: float, problem: str) -> None:
        """Note an answer; or, with a problem, that a ping did not leave and so is not lost."""
        if problem:
            self.problem = problem
            self.sent -= 1
        elif len(self.rtts_s) < self.sent:
            self.rtts_s.append(rtt_s)


PathKey = tuple[str, str, int]
"""(interface, peer, number of the peer's interface)"""


def node(state: State, expected: str | None) -> Iterator[Finding]:
    """Report which sidecar runs; `expected` is the name in the configuration, if that could be read."""
    told = state.get("node") or {}
    name = told.get("name")
    if expected is not None and name != expected:
        yield fail(
            "sidecar",
            f"{name} answers, but the configuration is for {expected}",
            "name the right sidecar: --config FILE, --socket PATH",
        )
    else:
        text = f"{name} ({told.get('role')}), version {told.get('version')}, up for {duration(told.get('up_s', 0.0))}"
        yield ok("sidecar", text)
    if told.get("insecure"):
        yield warn("sidecar", "insecure: true: nobody's identity is checked", "use tls_dir: plr ca issue")
    for refused in state.get("refused_peers") or ():
        yield warn("peer", f"{refused['name']} is refused: {refused['why']}", "see docs/start/certificates.md")


def stun(state: State) -> Iterator[Finding]:
    """Judge what STUN found from each interface's data socket."""
    if not (state.get("node") or {}).get("stun", True):
        yield ok("stun", "off in the configuration")
        return
    for interface in state["interfaces"]:
        if interface["suspended"]:
            continue
        answered = [one for one in interface["stun"] if _is_fresh(one)]
        for one in answered:
            yield ok("stun", _mapped(interface, one))
        for one in interface["stun"]:
            if one in answered:
                continue
            what = f"{interface['name']}: no answer over IPv{one['family']}"
            why = one["problem"] or (
                "asking" if one["answered_s"] is None else f"the last answer came {duration(one['answered_s'])} ago"
            )
            if answered:
                yield ok("stun", f"{what} ({why}): harmless, because the other family gets answers")
            else:
                remedy = f"{_stun_ports(state)}, a route over this interface, rp_filter"
                yield warn("stun", f"{what}: {why}", f"check {remedy}: docs/operate/troubleshooting.md, STUN fails")
        if interface["stun"]:
            continue
        if families := interface.get("stun_families"):
            known = " and ".join(f"IPv{family}" for family in families)
            yield warn(
                "stun",
                f"{interface['name']}: no STUN server is known for the family of its addresses, only for {known}",
                "if there is a NAT, name a server with such an address in stun.servers or the control plane's DNS",
            )
        else:
            yield warn(
                "stun", f"{interface['name']}: no STUN server is known", "check that the control plane's name resolves"
            )


def _stun_ports(state: State) -> str:
    """Return which ports have to be open: those of the servers that the sidecar asks."""
    servers = (state.get("node") or {}).get("stun_servers")
    if not servers:  # an earlier version does not report them
        return "the UDP port of the STUN servers"
    shown = [f"{port}/udp of {host}" for host, port in (server.rsplit(":", 1) for server in servers[:MAX_SHOWN_STUN])]
    return ", ".join(shown) + (f" and of {len(servers) - MAX_SHOWN_STUN} more" if len(servers) > MAX_SHOWN_STUN else "")


def _is_fresh(one: Mapping[str, Any]) -> bool:
    return one["mapping"] is not None and one["answered_s"] is not None and one["answered_s"] <= STUN_FRESH_S


def _mapped(interface: Mapping[str, Any], one: Mapping[str, Any]) -> str:
    address, port = one["mapping"]
    own = interface["addresses"]
    if address in own:
        nat = "no NAT" if port == interface["port"] else "the port differs from the socket's"
    else:
        nat = "a NAT that keeps the port" if port == interface["port"] else "a NAT that changes the port"
        if any(":" not in addr and ip_address(addr) in SHARED_ADDRESSES for addr in own):
            nat += ", of a carrier (100.64.0.0/10)"
    if one["changes"]:
        nat += f", mapping changed {one['changes']} times"
    return (
        f"{interface['name']}: seen as {_shown(address, port)} ({nat}), "
        f"answered {duration(one['answered_s'])} ago by {_shown(*one['server'])}"
    )


def _shown(host: str, port: int) -> str:
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def devices(state: State) -> Iterator[Finding]:
    """Report interfaces without a socket, and oddities of sockets and drivers."""
    for name, why in sorted((state.get("unopened") or {}).items()):
        remedy = (
            "find the program that has the port: sudo ss -ulnp; end it, or choose another udp_port"
            if os.strerror(errno.EADDRINUSE) in why
            else "see docs/operate/troubleshooting.md, An interface is not used; the sidecar tries again"
        )
        yield fail("interface", f"{name}: {why}", remedy)
    for interface in state["interfaces"]:
        if interface.get("bound_to") == "address":
            yield warn(
                "interface",
                f"{interface['name']}: its socket is bound to an address, not to the device",
                "give the unit CAP_NET_RAW: docs/start/install.md, More than one interface",
            )
        if interface.get("hangs"):
            times = interface["hangs"]
            yield warn(
                "interface", f"{interface['name']}: its driver hung {times} times", "check dmesg and the firmware"
            )


def mtu(state: State) -> Iterator[Finding]:
    """Compare what the paths carry with what their interfaces take."""
    takes = {interface["name"]: interface["mtu"] for interface in state["interfaces"]}
    for name, paths in sorted(_by(state["paths"], lambda path: path["interface"]).items()):
        carried: dict[int, int] = {}
        for path in paths:
            if path["state"] == "up" and path["address"] is not None:
                headers = HEADERS_V6 if ":" in path["address"][0] else HEADERS_V4
                carried[path["max_datagram"] + headers] = carried.get(path["max_datagram"] + headers, 0) + 1
        stuck = [path for path in paths if _is_stuck(path) and takes.get(name, 0) >= 1400]
        shown = ", ".join(f"{size} bytes ({count} paths)" for size, count in sorted(carried.items()))
        if 0 < takes.get(name, 0) < LEAST_MTU:
            yield fail(
                "mtu",
                f"{name}: takes {takes[name]} bytes, but larger requests need {LEAST_MTU} and do not get through",
                f"ip link set {name} mtu 1280 or more, if the network carries that",
            )
        elif stuck:
            yield warn(
                "mtu",
                f"{name}: takes {takes[name]} bytes, but paths to {_names(stuck)} carry only the minimum, {BASE_BYTES}",
                "find what drops long packets: a tunnel, or a firewall that drops fragments",
            )
        elif shown:
            yield ok("mtu", f"{name}: takes {takes.get(name, '?')} bytes, paths carry {shown}")


def _is_stuck(path: Mapping[str, Any]) -> bool:
    return path["state"] == "up" and path["max_datagram"] <= BASE_BYTES and (path.get("since_s") or 0.0) > SEARCHED_S


def paths(state: State, pings: Mapping[PathKey, Pinged]) -> Iterator[Finding]:
    """Judge each path; for paths that are down, name what to blame: an interface, a peer, or the path itself."""
    by_interface = _by(state["paths"], lambda path: path["interface"])
    by_peer = _by(state["paths"], lambda path: path["peer"])
    dark_interfaces = {name for name, ones in by_interface.items() if all(_is_down(one) for one in ones)}
    dark_peers = {name for name, ones in by_peer.items() if all(_is_down(one) for one in ones)}
    if not by_peer:
        yield _no_peer(state)
        return
    if len(dark_peers) == len(by_peer) and _just_started(state):
        yield warn("path", "no peer is reached yet: the sidecar has just started", "try again in a moment")
    elif len(dark_peers) == len(by_peer):
        yield fail(
            "path",
            f"no peer is reached over {', '.join(sorted(by_interface))}: {_why(state['paths'])}",
            "check the interfaces above, then the peers' UDP port: docs/operate/troubleshooting.md, A path is down",
        )
    else:
        for name in sorted(dark_interfaces):
            yield warn(
                "path",
                f"{name}: no peer is reached over it, but some are over others: {_why(by_interface[name])}",
                f"check carrier and firewall: ping -I {name} CLOUD; docs/operate/troubleshooting.md, A path is down",
            )
        for name in sorted(dark_peers):
            ones = [one for one in by_peer[name] if one["interface"] not in dark_interfaces]
            yield warn(
                "path",
                f"{name}: not reached over {_over(ones or by_peer[name])}, but others are: {_why(by_peer[name])}",
                f"check that the host of {name} is up, its sidecar runs and its UDP port is open",
            )
    ones = sorted(state["paths"], key=lambda one: (one["peer"], one["interface"], one["remote"]))
    blame = losses.blame(ones)
    yield from blame.findings
    told = {(path["interface"], path["peer"]) for path in ones if not _is_down(path)}
    for number, path in enumerate(ones):
        blamed = path["interface"] in dark_interfaces or path["peer"] in dark_peers
        # It is normal that a further interface of a peer (IPv6-only, an inner network) is not reached from here.
        if _is_down(path) and (blamed or (path["interface"], path["peer"]) in told):
            continue
        pinged = pings.get((path["interface"], path["peer"], path["remote"]))
        yield _path(path, pinged, blame.explained.get(number))


def _just_started(state: State) -> bool:
    return bool((state.get("node") or {}).get("up_s", STARTED_S) < STARTED_S)


def _is_robot(state: State) -> bool:
    return (state.get("node") or {}).get("role") == "robot"


def _no_peer(state: State) -> Finding:
    """Say why no peer is known. A robot cannot do its job then; a cloud waits for robots."""
    level = fail if _is_robot(state) and not _just_started(state) else warn
    told = state.get("control") or {}
    others = "cloud server" if _is_robot(state) else "robot"
    if dormant := removed_peers.dormant(state):
        remedy = "see the interfaces above, and run plr doctor on the peer's host"
        if not told.get("connected"):
            remedy += "; see control below"
        return level(
            "path",
            f"no peer is reached; the control plane removed these, and this sidecar keeps them: {dormant}. It talks to "
            "each as soon as a path answers",
            f"{remedy}. Do not restart this sidecar: it would forget them. {removed_peers.SEE}",
        )
    if not told.get("connected"):
        why = told.get("last_failure") or "not connected yet"
        names = ", ".join(told.get("names") or ())
        return level(
            "path",
            f"no peer is known: the control plane {names} is not reached ({why}), and no peer is known from before",
            "see control below: docs/operate/troubleshooting.md, The control plane is out of reach",
        )
    if state.get("refused_peers"):
        return level("path", "no peer is accepted: all that the control plane names are refused", "see peer above")
    return level(
        "path",
        f"no peer is known: the control plane names no {others} to this node; none is registered, or the policy lets "
        "this node use none",
        f"on the operator's host: plr status shows whether a {others} is registered, and plr events when one left; for "
        "the policy see docs/use/access-control.md",
    )


def gone(state: State) -> Iterator[Finding]:
    """Report nodes that were peers a while ago but are no longer: they are missing from all other checks."""
    now = {path["peer"] for path in state["paths"]}
    left = {
        peer: ones for peer, ones in _by(state.get("gone") or (), lambda one: one["peer"]).items() if peer not in now
    }
    for name, ones in list(left.items())[:MAX_SHOWN_GONE]:
        since = duration(min(one["since_s"] for one in ones))
        reasons = sorted({one["reason"] for one in ones})
        if reasons == [GOODBYE]:
            yield ok("peer", f"{name}: said goodbye {since} ago")
            continue
        yield warn(
            "peer",
            f"{name}: gone for {since}: {', '.join(reasons)} over {_over(ones)}; it is no longer a peer",
            f"check that the host of {name} is up and its sidecar runs; plr status shows when and why it left",
        )
    if len(left) > MAX_SHOWN_GONE:
        yield ok("peer", f"at least {len(left) - MAX_SHOWN_GONE} more nodes were peers within the last hour")


def _path(path: Mapping[str, Any], pinged: Pinged | None, blamed: str | None) -> Finding:
    """Judge one path; `blamed` is what its losses are blamed on, if not on itself."""
    where = "" if path["address"] is None else f" ({_shown(*path['address'])})"
    since = "" if path["since_s"] is None else f" for {duration(path['since_s'])}"
    name = f"{path['interface']} to {path['peer']}{where}"
    if _is_down(path):
        why = f", {path['reason']}" if path["reason"] else ""
        remedy = f"ping -I {path['interface']} {path['address'][0] if path['address'] else path['peer']}"
        return warn("path", f"{name}: down{since}{why}", f"{remedy}; docs/operate/troubleshooting.md, A path is down")
    measured = f"round trip {milliseconds(path['rtt_s'])}" if path["rtt_s"] else "round trip unknown"
    text = f"{name}: {path['state']}{since}, {measured}, {losses.told(path)}"
    if path["rests"]:
        text += f", at rest (last heard {duration(path['proven_s'])} ago)"
    if pinged is not None and pinged.sent <= 0 and pinged.problem:
        text += f"; not pinged: {pinged.problem}"
    elif pinged is not None and pinged.sent > 0:
        if not pinged.rtts_s:
            text += f"; none of {pinged.sent} pings was answered"
            return warn("path", text, f"try again: plr ping {path['peer']}")
        slowest, fastest = milliseconds(max(pinged.rtts_s)), milliseconds(min(pinged.rtts_s))
        text += f"; ping {fastest} to {slowest}, {pinged.sent - len(pinged.rtts_s)} of {pinged.sent} lost"
    if path["state"] != "up":
        return warn("path", text, f"the path may be about to go down: plr ping {path['peer']} -I {path['interface']}")
    if losses.is_lossy(path):
        if blamed is not None:
            return ok("path", f"{text}: see {blamed} above")
        return warn("path", text, f"check the carrier: the signal may be weak, or a queue full; {losses.SEE}")
    return ok("path", text)


def _is_down(path: Mapping[str, Any]) -> bool:
    return bool(path["state"] == "down")


def _why(ones: Sequence[Mapping[str, Any]]) -> str:
    never = "never answered"
    if not any(one.get("candidates", 1) or one["address"] for one in ones):
        never = f"{_names(ones)} announced no address (plr doctor there says why)"
    reasons = sorted({one["reason"] for one in ones if one["reason"]}) or [never]
    known = [one["since_s"] for one in ones if one["since_s"] is not None]
    return ", ".join(reasons) + (f" for {duration(min(known))}" if known else "")


def _over(ones: Sequence[Mapping[str, Any]]) -> str:
    return ", ".join(sorted({one["interface"] for one in ones}))


def _names(ones: Sequence[Mapping[str, Any]]) -> str:
    return ", ".join(sorted({one["peer"] for one in ones}))


def _by(ones: Sequence[dict[str, Any]], key: Callable[[dict[str, Any]], str]) -> dict[str, list[dict[str, Any]]]:
    groups: dict[str, list[dict[str, Any]]] = {}
    for one in ones:
        groups.setdefault(key(one), []).append(one)
    return groups


def services(state: State) -> Iterator[Finding]:
    """Judge the services that are carried."""
    told = state.get("services") or {}
    node = state.get("node") or {}
    robot = _is_robot(state)
    if robot:
        who = "any cloud server that the control plane names to this robot"
        remedy = (
            "on the operator's host: plr status shows what the servers offer (compare the names), and plr explain "
            f"{node.get('name') or 'ROBOT'} SERVICE whether the policy denies it"
        )
    else:
        who, remedy = _domain(node)
    carried = told.get("carried") or {}
    # A robot without a single service cannot do its job; one that has just started may have them in a moment.
    useless = robot and not carried and not told.get("left_alone") and not _just_started(state)
    level = fail if useless else warn
    odd = _by(told.get("conflicts") or (), lambda one: one["service"])
    for name in told.get("unmet") or ():
        if robot and not state["paths"]:
            yield level("service", f"{name}: configured, but no cloud server is {_known(state)}", "see path above")
        elif name not in odd:
            yield level("service", f"{name}: configured, but not offered by {who}", remedy)
    for name, ones in sorted(odd.items()):
        kinds = ", ".join(f"{one['server']} offers it as {one['type']}" for one in ones[:MAX_SHOWN_CONFLICTS])
        yield (level if name in (told.get("unmet") or ()) else warn)(
            "service",
            f"{name}: {kinds}, unlike the configuration or the other servers, so it gets no requests there",
            "let all servers offer it with one type, and correct the key type of the service if it is set",
        )
    for name in told.get("mismatched") or ():
        text = f"{name}: served by a node of this host's ROS domain, with an incompatible QoS"
        yield warn("service", text, "create the server with the default QoS of services, which is reliable")
    for name in told.get("silent") or ():
        text = f"{name}: the process of its server ended, or shows no sign of life"
        yield fail("service", text, "check whether that process hangs; if so, restart it")
    for name, servers in sorted((told.get("unreached") or {}).items()):
        text = f"{name}: offered by {servers} servers that this robot knows, but none of them is reached"
        yield level("service", text, "see path")
    for name, nodes in sorted((told.get("left_alone") or {}).items()):
        text = f"{name}: served by {', '.join(nodes)} on this robot, so the sidecar does not offer it"
        yield warn("service", text, "stop that node, or rename its service")
    if carried:
        yield ok("service", f"offered {'here' if robot else 'to robots'}: {', '.join(sorted(carried))}")
    else:
        yield level("service", *_none_offered(state))


def _known(state: State) -> str:
    """Return what no peer is, if there is no path: known, or reached."""
    return "reached" if removed_peers.dormant(state) else "known"


def _none_offered(state: State) -> tuple[str, str]:
    """Return why no service is offered here, and what to do."""
    see = "docs/operate/troubleshooting.md, The service does not appear on the robot"
    if not _is_robot(state):
        return "none is offered", see
    told = state.get("services") or {}
    if not state["paths"]:
        return f"none is offered, because no peer is {_known(state)}", "see path above"
    if told.get("unmet"):
        return "none is offered: no server offers what is configured", f"see the lines above; {see}"
    if told.get("unreached"):
        return "none is offered: no server of a configured service is reached", "see path above"
    if told.get("missing_types"):
        return "none is offered: the types of all services are missing here", "see types above"
    return "none is offered: no server that this robot knows offers a service that services names", see


def _domain(node: Mapping[str, Any]) -> tuple[str, str]:
    """Return in which ROS domain a cloud looks for servers, and what to do if it finds none."""
    domain = "ROS_DOMAIN_ID"
    told = node.get("environment")  # an earlier version does not report it
    shown = f", {domain} {told.get(domain) or '0'}" if isinstance(told, dict) else ""
    remedy = f"compare the names (plr status), and the {domain} that the server was started with"
    return f"a node of this host's ROS domain{shown}", remedy


def mapping(state: State, targets: Callable[[str], float | None]) -> Iterator[Finding]:
    """Judge a robot's mapping; `targets` returns the largest share of misses that a service may have."""
    if not _is_robot(state):
        return
    told = state.get("mapping") or {}
    carried = (state.get("services") or {}).get("carried") or {}
    ways = {one["service"]: one["paths"] for one in state.get("ways") or ()}
    if not told.get("version"):
        if carried:
            text, advice = (
                "none: this robot chooses paths by round-trip time",
                "check that the control plane is reached: see control",
            )
        else:
            text, advice = "none: no service is offered yet", "see service"
        yield warn("mapping", text, advice)
    elif told.get("source") == "disk":
        where = f"version {told['version']}, kept on disk by an earlier run"
        yield warn("mapping", f"{where}: the control plane has not sent a newer one", "see control below")
    else:
        where = f"version {told['version']} of the control plane, in force for {duration(told.get('age_s') or 0.0)}"
        yield ok("mapping", where)
    down = {(one["interface"], one["peer"]) for one in state["paths"]}
    down -= {(one["interface"], one["peer"]) for one in state["paths"] if not _is_down(one)}
    any_up = any(not _is_down(one) for one in state["paths"])
    for one in state["mapped"]:
        service = one["service"]
        dead = [pair for pair in one["pairs"] if (pair["interface"], pair["server"]) in down]
        if not one["pairs"]:
            yield _unmapped(service, one.get("reason") or "", ways.get(service), any_up=any_up)
        elif dead:
            yield _mapped_to_dead(one, dead, ways.get(service))
        else:
            yield _mapped_to_live(one, targets(service))
    for service in sorted(carried.keys() - {one["service"] for one in state["mapped"]}):
        if service in ways:
            yield _unmapped(service, "not sent yet", ways[service], any_up=any_up)


def _unmapped(service: str, why: str, live: Sequence[Mapping[str, Any]] | None, *, any_up: bool) -> Finding:
    """Judge a service for which the control plane names no path; `live` are the paths that it takes all the same.

    `any_up`: whether any path to any peer is up.
    """
    text = f"{service}: no mapping from the control plane{f' ({why})' if why else ''}"
    if live:
        # Nothing predicts misses for these paths.
        return warn(
            "mapping",
            f"{text}; requests go over these live paths: {_pairs(live)}",
            "nothing, while requests are answered; for the reason see control below, and plr explain",
        )
    if live is None and any_up:  # an earlier version does not report them
        return warn(
            "mapping", f"{text}; requests go over live paths, if there are any to a server of it", "see path above"
        )
    return fail(
        "mapping",
        f"{text}, and no path to a server of it is up: requests go nowhere",
        "no server is reached that offers it: see path above, plr status",
    )


def _mapped_to_dead(
    one: Mapping[str, Any], dead: Sequence[Mapping[str, Any]], live: Sequence[Mapping[str, Any]] | None
) -> Finding:
    """Judge a service with mapped pairs that are down."""
    text = f"{one['service']} goes over {_pairs(one['pairs'])}, but {_pairs(dead)} is down"
    if live is None:  # an earlier version does not report them
        return warn("mapping", f"{text}: other paths are used", "see path above")
    if not live:
        return fail("mapping", f"{text}, and no other path to a server of it is up", "see path above")
    return warn("mapping", f"{text}; requests go over these live paths: {_pairs(live)}", "see path above")


def _mapped_to_live(one: Mapping[str, Any], target: float | None) -> Finding:
    """Judge a service whose mapped pairs are up; `target` is the largest share of misses that it may have."""
    miss = one["predicted_miss"]
    predicted = "unknown" if miss is None else share(miss)
    text = f"{one['service']} goes over {_pairs(one['pairs'])}; predicted to miss {predicted}"
    if target is not None and miss is not None and miss > target:
        return warn("mapping", f"{text}, more than its target {share(target)}", "to see why: plr explain")
    if target is None and miss is not None and miss > HOPELESS:
        return warn("mapping", text, "to see why: plr explain")
    return ok("mapping", text)


def _pairs(pairs: Sequence[Mapping[str, Any]]) -> str:
    return ", ".join(f"{pair['interface']} to {pair['server']}" for pair in pairs)


def control(state: State) -> Iterator[Finding]:
    """Judge the control stream."""
    told = state.get("control") or {}
    names = ", ".join(told.get("names") or ())
    since = duration(told.get("since_s") or 0.0)
    if told.get("connected"):
        over = told.get("interface") or "the routing table's interface"
        last = f"; before: {told['last_failure']}" if told.get("last_failure") else ""
        yield ok("control", f"{names} reached for {since}, over {over}{last}")
        return
    why = told.get("last_failure") or "not connected yet"
    dormant = removed_peers.dormant(state)
    if state["paths"]:
        then = "requests continue with what it sent before"
    elif dormant:
        then = "the peers that it removed are kept, and requests continue as soon as a path to one answers"
    elif (state.get("mapping") or {}).get("version"):
        then = "its last mapping is kept, but no peer is known"
    else:
        then = "nothing that it sent before is known"
    yield warn(
        "control",
        f"{names} not reached for {since}: {why}; {then}",
        "docs/operate/troubleshooting.md, The control plane is out of reach",
    )
