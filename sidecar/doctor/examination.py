"""Examines a node: reads what the checks judge, queries the running sidecar, pings its paths."""

from __future__ import annotations

import errno
import os
import time
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from plr.protos.base.errors import ConfigError, DecodeError
from plr.protos.model.ids import NodeName, ServiceName
from plr.protos.program.config_file import parse_yaml, read_text
from plr.protos.program.regular_file import read_regular
from plr.protos.program.tls_files import load_tls_files
from plr.protos.trust.identity import Identity, IdentityRole
from plr.sidecar.config.service_user import unreadable, unreadable_program
from plr.sidecar.config.sidecar import load_config
from plr.sidecar.core.rules.service_rule import Rules
from plr.sidecar.doctor import host, node_checks, removed_peers, running_checks
from plr.sidecar.doctor.finding import fail, ok, warn
from plr.sidecar.doctor.running_checks import Pinged
from plr.sidecar.local.client import LocalBusyError, LocalClient, LocalError, LocalRefusedError
from plr.sidecar.local.protocol import MAX_REQUESTS_OF_CONNECTION
from plr.sidecar.net.interfaces import choose, list_interfaces
from plr.sidecar.ros import environment, shared_memory, static_peers
from plr.sidecar.ros.errors import RosBridgeError
from plr.sidecar.state.file import MAX_STATE_FILE_BYTES, decode_clock_floor, decode_last_good
from plr.sidecar.state.store import CLOCK_FILE, LAST_GOOD_FILE

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from typing import TypeVar

    from plr.protos.program.tls_files import TlsFiles
    from plr.sidecar.config.sidecar import SidecarConfig
    from plr.sidecar.doctor.finding import Finding
    from plr.sidecar.doctor.running_checks import PathKey

    T = TypeVar("T")

DEFAULT_CONFIG = Path("/etc/plr/sidecar.yaml")
RUNTIME_SOCKET = Path("/run/plr/sidecar.sock")
PINGS = 3
PING_EVERY_S = 0.2
PING_BYTES = 64
PING_PATIENCE_S = 2.0
PINGING_S = 10.0
"""Limit for all pings together, however many peers do not answer."""
MAX_PATHS_OF_AN_INTERFACE = 12
"""Paths to ping: three times as many pings at once as an interface lets through."""


@dataclass(slots=True)
class Examination:
    """The findings, and what they are based on."""

    findings: list[Finding] = field(default_factory=list)
    state: dict[str, Any] | None = None
    """State of the running sidecar; None if it does not answer."""
    config: SidecarConfig | None = None


@dataclass(frozen=True, slots=True)
class Where:
    """Which sidecar to examine."""

    config: Path = DEFAULT_CONFIG
    socket: Path | None = None
    """None: as configured."""


def sockets(where: Where, config: SidecarConfig | None) -> list[Path]:
    """Return where the sidecar's socket may be, the likeliest path first."""
    if where.socket is not None:
        return [where.socket]
    if config is not None:
        told, state_dir = config.local_socket, config.state_dir
    else:
        told, state_dir = _as_written(where.config)
    if told != "auto":
        return [] if told is None else [Path(told)]
    return [state_dir / "sidecar.sock", RUNTIME_SOCKET]


def _as_written(path: Path) -> tuple[str | None, Path]:
    """Return local_socket and state_dir of a configuration that is wrong, or whose certificate this user may not read.

    It may still tell where the running sidecar is.
    """
    try:
        data = parse_yaml(read_text(path), str(path))
    except ConfigError:
        data = {}
    told, state_dir = data.get("local_socket", "auto"), data.get("state_dir")
    return (
        told if told is None or isinstance(told, str) else "auto",
        Path(state_dir if isinstance(state_dir, str) else "/var/lib/plr"),
    )


def connect(where: Where, config: SidecarConfig | None) -> LocalClient:
    """Return a connection to the running sidecar; raise LocalError, which says why there is none."""
    said: list[LocalError] = []
    for path in sockets(where, config):
        try:
            return LocalClient(path, _owners(where.config))
        except LocalError as error:
            said.append(error)
    for one in said:
        if isinstance(one, LocalBusyError):
            raise one
    # The last error counts: a member of the group may not look into the state folder, wherever the sidecar is.
    if said and isinstance(said[-1], LocalRefusedError):
        raise said[-1]
    raise LocalError(" and ".join(map(str, said)) or "local_socket is null in the configuration")


def _owners(config: Path) -> frozenset[int]:
    """Return the users whose sidecar it may be: the owner of the configuration decides what is queried anyway."""
    try:
        return frozenset({config.stat().st_uid})
    except (OSError, ValueError):
        return frozenset()


def read_config(where: Where, told: Mapping[str, Any] | None = None) -> SidecarConfig:
    """Read the configuration; raise ConfigError.

    `told` is the `node` part of the running sidecar's state: its name and role, if this user may not read the
    certificate.
    """

    def identify(folder: Path) -> Identity:
        try:
            return load_tls_files(folder).identity
        except ConfigError:
            if not told:
                raise
        role = IdentityRole.ROBOT if told.get("role") == "robot" else IdentityRole.CLOUD
        return Identity(NodeName(str(told.get("name"))), role, 0, 0.0, 0.0)

    return load_config(where.config, identify)


def examine(where: Where, *, pinging: bool = True) -> Examination:
    """Examine everything; this takes some seconds, most of them for pings."""
    seen = Examination()
    config, problem = _try_config(where, None)
    client = None
    try:
        client = connect(where, config)
        seen.state = client.state()
    except LocalError as error:
        seen.findings.append(_not_running(error, where))
    if config is None and seen.state is not None:
        config, problem = _try_config(where, seen.state.get("node"))
    seen.config = config
    if seen.state is not None:
        expected = None if config is None else config.name
        seen.findings += _judged(lambda state: running_checks.node(state, expected), seen.state)
    if problem is not None:
        seen.findings.append(_wrong(problem))
    elif config is not None:
        seen.findings.append(ok("configuration", f"{where.config} is valid"))
    now_wall = time.time()
    seen.findings += _certificate_and_clock(config, seen.state, now_wall)
    if config is not None and seen.state is None and (found := unreadable(where.config, config.tls_dir)) is not None:
        # A running sidecar says itself which files it cannot read.
        seen.findings.append(warn("certificate", found.text, found.remedy))
    if seen.state is None and (found := unreadable_program(where.config)) is not None:
        seen.findings.append(fail("sidecar", found.text, found.remedy))
    seen.findings += _ros(where, config, seen.state)
    seen.findings += _interfaces(config, seen.state)
    if seen.state is not None and client is not None:
        pings = _ping_all(client, seen.state) if pinging else {}
        seen.findings += _running(config, seen.state, pings)
    if client is not None:
        client.close()
    return seen


def _try_config(where: Where, told: Mapping[str, Any] | None) -> tuple[SidecarConfig | None, ConfigError | None]:
    try:
        return read_config(where, told), None
    except ConfigError as error:
        return None, error


def _wrong(problem: ConfigError) -> Finding:
    if problem.problem.endswith(os.strerror(errno.EACCES)):
        return warn("configuration", f"{problem}: this user may not read it, so it is not checked", "sudo plr doctor")
    return fail("configuration", str(problem), "correct it, then run: plr-sidecar --config FILE --check-config")


def _not_running(error: LocalError, where: Where) -> Finding:
    if isinstance(error, LocalRefusedError):
        return fail("sidecar", f"not asked: {error}", "sudo plr doctor; or: usermod -aG plr $USER, and log in again")
    if isinstance(error, LocalBusyError):
        text = f"no answer: {error}; the other checks run without it"
        return fail(
            "sidecar",
            text,
            "try again; see: systemctl status plr-sidecar; to see who asks: sudo ss -xp | grep sidecar.sock",
        )
    remedy = "systemctl start plr-sidecar, and see: journalctl -u plr-sidecar -n 20"
    if where.config != DEFAULT_CONFIG:
        remedy = f"plr-sidecar --config {where.config}"
    return fail("sidecar", f"the sidecar is not running: {error}; the other checks run without it", remedy)


def _certificate_and_clock(
    config: SidecarConfig | None, state: dict[str, Any] | None, now_wall: float
) -> Iterator[Finding]:
    used = None if state is None else state.get("certificate")
    files: TlsFiles | None = None
    broken: str | None = None
    if config is not None and config.tls_dir is not None:
        try:
            files = load_tls_files(config.tls_dir)
        except ConfigError as error:
            if used is None:
                yield fail("certificate", str(error), "create it with plr ca issue, or run plr doctor as root")
            elif not _is_for_others(error):
                broken = str(error)
    if files is not None:
        yield from node_checks.certificate(files, now_wall)
    elif used is not None:
        yield from node_checks.certificate_in_use(used, now_wall)
    if used is not None:
        yield from node_checks.files_on_disk(files, broken, used)
    floors = [float(((state or {}).get("clock") or {}).get("floor") or 0.0)]
    if config is not None:
        floors.append(_read_state(config.state_dir / CLOCK_FILE, decode_clock_floor) or 0.0)
    if files is not None:
        # As a starting sidecar does: the time of anything that the CA has signed is no later than now.
        floors.append(files.identity.not_before)
        floors += [one.signed_at for one in files.trust.lists().values() if one is not None]
    yield from node_checks.clock(now_wall, max(floors), host.clock_state())


def _is_for_others(error: ConfigError) -> bool:
    """Return whether this user may not read a file; the sidecar's user may."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, PermissionError):
        cause = cause.__cause__
    return cause is not None


def _read_state(path: Path, decode: Callable[[bytes], T]) -> T | None:
    """Return the content of a file of the state folder if it exists, is readable for this user, and is valid."""
    try:
        return decode(read_regular(path, MAX_STATE_FILE_BYTES))
    except (OSError, DecodeError):
        return None


def _ros(where: Where, config: SidecarConfig | None, state: dict[str, Any] | None) -> Iterator[Finding]:
    shell = dict(os.environ)
    if state is not None:
        # The sidecar says whether its rclpy works; this shell may have a different one.
        node = state.get("node") or {}
        used = node_checks.running_environment(node, shell)
        others = shared_memory.users_of_domain(used)
        of_unit = host.unit_environment(where.config).of_unit
        wrong = node.get("ros_problem") or None
        yield from node_checks.static_peers(node.get("left_out_peers") or ())
        yield from node_checks.ros(used, shell, wrong, of_unit=of_unit, user=node.get("user"), others=others)
        told = state.get("services") or {}
        yield from node_checks.types(told.get("carried") or {}, told.get("missing_types") or {})
        return
    unit = host.unit_environment(where.config)
    if unit.refused:
        remedy = (
            f"let it and its folder belong to root or the configuration's owner, who alone may write: {where.config}"
        )
        yield warn("ros", unit.refused, remedy)
    used = unit.variables
    wrong = environment.problem(used, thorough=True)
    yield from node_checks.static_peers(static_peers.unresolvable(used))
    others = shared_memory.users_of_domain(used)
    for one in node_checks.ros(used, shell, wrong, of_unit=unit.of_unit, user=unit.user, others=others):
        known = unit.of_unit or one.check != "domain"
        yield (
            one
            if known
            else replace(one, text=f"{one.text} (the environment of this shell: no unit starts {where.config})")
        )
    if config is not None and (wanted := _types_wanted(config)):
        if wrong is not None:
            names = ", ".join(f"{name} ({kind})" for name, kind in sorted(wanted.items()))
            yield warn("types", f"not checked, because ROS does not work here: {names}", "see ros above")
            return
        yield from node_checks.types(wanted, {name: kind for name, kind in wanted.items() if not _is_installed(kind)})


def _types_wanted(config: SidecarConfig) -> dict[str, str]:
    """Return the types of the configured services: those of the configuration, and those last offered of the others."""
    last = _read_state(config.state_dir / LAST_GOOD_FILE, lambda data: decode_last_good(data, config.node_name))
    rules = Rules(config.service_rules())
    offers = [offer for peer in last.peers.peers for offer in peer.offers] if last is not None and last.peers else []
    wanted: dict[str, str] = {}
    for offer in offers:
        if (rule := rules.find(offer.name)) is not None:
            wanted[offer.name] = rule.type or offer.type
    return wanted | {rule.pattern: rule.type for rule in config.service_rules() if rule.type}


def _is_installed(kind: str) -> bool:
    try:
        from plr.sidecar.ros.types import load_service_type

        load_service_type(kind)
    except (ImportError, RosBridgeError):
        return False
    return True


def _interfaces(config: SidecarConfig | None, state: dict[str, Any] | None) -> Iterator[Finding]:
    try:
        choice = choose(list_interfaces(), None if config is None else config.interfaces)
    except OSError as error:
        yield warn("interface", f"cannot be listed: {error}", "check that netlink is allowed here")
        return
    used = None if state is None or config is None else {one.get("name") for one in state["interfaces"]}
    yield from node_checks.interfaces(choice, used, (state or {}).get("unopened") or ())
    names = [one.name for one in choice.usable if one.kind != "loopback"]
    yield from node_checks.reverse_path({name: host.reverse_path_filter(name) for name in names})


def _running(config: SidecarConfig | None, state: dict[str, Any], pings: Mapping[PathKey, Pinged]) -> Iterator[Finding]:
    rules = None if config is None else Rules(config.service_rules())
    targets = {} if config is None else {service.name: service.target_miss for service in config.services}

    def target(service: str) -> float | None:
        rule = None if rules is None else rules.find(ServiceName(service))
        return None if rule is None else targets.get(rule.pattern)

    yield from _judged(running_checks.devices, state)
    yield from _judged(running_checks.stun, state)
    yield from _judged(running_checks.mtu, state)
    yield from _judged(lambda told: running_checks.paths(told, pings), state)
    yield from _judged(removed_peers.findings, state)
    yield from _judged(lambda told: running_checks.gone(removed_peers.without(told)), state)
    yield from _judged(running_checks.services, state)
    yield from _judged(lambda told: running_checks.mapping(told, target), state)
    yield from _judged(running_checks.control, state)


def _judged(check: Callable[[dict[str, Any]], Iterator[Finding]], state: dict[str, Any]) -> list[Finding]:
    try:
        return list(check(state))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        text = f"the sidecar's answer is not understood ({type(error).__name__}: {error})"
        return [warn("sidecar", text, "use a plr of the same version as the sidecar: plr --version")]


def _ping_all(client: LocalClient, state: dict[str, Any]) -> dict[PathKey, Pinged]:
    """Ping the paths that are not down, PINGS times each; of very many, only some."""
    chosen: Counter[str] = Counter()
    pings: dict[PathKey, Pinged] = {}
    peers: dict[str, None] = {}
    for path in state["paths"]:
        if path["state"] != "down" and chosen[path["interface"]] < MAX_PATHS_OF_AN_INTERFACE:
            chosen[path["interface"]] += 1
            peers[path["peer"]] = None
            pings[path["interface"], path["peer"], path["remote"]] = Pinged()
    end = time.monotonic() + PINGING_S
    try:
        asked: dict[int, str] = {}
        for turn in range(PINGS):
            for peer in peers:
                if time.monotonic() > end:
                    return pings
                # The sidecar answers MAX_REQUESTS_OF_CONNECTION at once, and may be slow with some.
                _listen(client, asked, pings, PING_PATIENCE_S, until=MAX_REQUESTS_OF_CONNECTION - 1)
                asked[client.ping(peer, None, PING_BYTES)] = peer
            last = turn == PINGS - 1
            _listen(client, asked, pings, PING_PATIENCE_S if last else PING_EVERY_S, until=0 if last else -1)
    except LocalError:
        pass  # what was answered until then is reported
    return pings


def _listen(
    client: LocalClient, asked: dict[int, str], pings: dict[PathKey, Pinged], patience_s: float, *, until: int
) -> None:
    """Take answers until at most `until` requests are outstanding."""
    end = time.monotonic() + patience_s
    while len(asked) > until:
        line = client.next_line(end - time.monotonic())
        if line is None:
            return
        peer = asked.get(line.get("id") or 0)
        if peer is None:
            continue
        if line.get("end") or "error" in line:
            del asked[line["id"]]
        elif line.get("part") == "pinged":
            for one in line["value"]:
                if (pinged := pings.get((one["interface"], peer, one["remote"]))) is not None:
                    pinged.sent += 1
        elif line.get("part") == "pong":
            pong = line["value"]
            if (pinged := pings.get((pong["interface"], peer, pong["remote"]))) is not None:
                pinged.take(pong["rtt_s"], pong["problem"])
