"""Defines and loads the sidecar's configuration: one YAML file, validated once, frozen, passed in."""

from __future__ import annotations

import enum
import fnmatch
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self

from pydantic import AfterValidator, Field, model_validator

from plr.protos.base.errors import ConfigError
from plr.protos.base.host_port import is_loopback
from plr.protos.model.ids import NodeName, Role, ServiceName
from plr.protos.model.members import DEFAULT_COST_PER_REQUEST, InterfaceLabel
from plr.protos.program.config_fields import (
    AbsolutePath,
    IpAddress,
    ListenAddress,
    RemoteAddress,
    TlsDir,
    check_absolute,
    check_security,
    converted,
    refuse_duplicates,
    text_of,
)
from plr.protos.program.config_file import key_path, parse_yaml, read_text, validate
from plr.protos.trust.identity import IdentityRole
from plr.sidecar.config.fields import (
    ROLE_IN_SCHEMA,
    ControlPlaneAddresses,
    DomainLabel,
    InterfacePattern,
    LocalSocket,
    OnlyOn,
    Section,
    SidecarName,
    is_glob,
)
from plr.sidecar.config.service import NetworkConfig, ServiceConfig
from plr.sidecar.core.control.ways import Price
from plr.sidecar.core.rules.service_rule import Rules, ServiceRule

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from plr.protos.model.ids import InterfaceName
    from plr.protos.trust.identity import Identity
    from plr.sidecar.core.rules.budget import Budget

DEFAULT_CLOUD_UDP_PORT = 24700
"""Fixed, as a firewall rule has to name it; below Linux's ephemeral ports (32768 and up)."""

MAX_SERVICES = 1024
"""Entries of `services`: more than a sidecar offers or carries. A glob stands for any number of services."""


class LogLevel(enum.Enum):
    """How much is logged."""

    DEBUG = "debug"
    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


class StunConfig(Section):
    """How the sidecar learns its addresses as seen from outside."""

    enabled: bool = True
    """Set `false` only if no NAT lies between the sidecars, as between clouds with public addresses."""
    servers: Annotated[tuple[RemoteAddress, ...], AfterValidator(refuse_duplicates), converted] = ()
    """STUN servers to ask. If the list is empty, the sidecar asks those that the control plane names. If the control
    plane names none, the sidecar asks port 3478 of the control plane's host."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.servers and not self.enabled:
            raise ValueError("expected no servers while enabled is false")
        return self


class AdvertisedAddress(Section):
    """A public address that a 1:1 NAT translates to one interface of a cloud."""

    address: IpAddress
    """IPv4 or IPv6 address without a port. The NAT must keep `udp_port`."""
    interface: Annotated[InterfacePattern, text_of("name")] | None = None
    """Name of the interface behind that address. Without this key, it is the first usable interface."""


class SidecarConfig(Section):
    """Configuration of plr-sidecar."""

    name: SidecarName
    """Name of this sidecar. It must be unique among all sidecars of the control plane, which refuses a second holder.
    With `tls_dir`, the certificate contains the name, and you may leave this key out. `plr status` and the labels of
    metrics show the name."""
    role: Annotated[Role, converted]
    """What this host does. With `tls_dir`, the certificate contains the role, and you may leave this key out.

    - `robot`: its applications call services.
    - `cloud`: its servers answer them."""
    control_plane: ControlPlaneAddresses
    """Where the control plane serves gRPC. Write an IPv6 address in brackets. The sidecar tries every address over
    every interface in use, and takes the first that answers. An IP address works even if the name server is out of
    reach."""
    tls_dir: Annotated[TlsDir, converted] | None = None
    """Required without `insecure`. Folder with `cert.pem`, `key.pem`, `ca.pem` and perhaps `crl.pem`.
    `plr ca issue NAME --role robot` (or `--role cloud`) writes it. The sidecar checks the folder once a second. With a
    new certificate it opens a new stream to the control plane, and requests continue meanwhile."""
    insecure: bool = False
    """`true` in place of `tls_dir` turns certificates off. Every sidecar can then claim any name, and anyone on the
    network can read and change the traffic. Use it only for trials on one machine. The sidecar then refuses a
    `control_plane` on another host, unless the command line contains `--insecure-i-know`."""
    services: Annotated[tuple[ServiceConfig, ...], Field(min_length=1, max_length=MAX_SERVICES), converted]
    """The services that the sidecar carries. It carries no others. The first entry that matches a service's name
    applies."""
    interfaces: (
        Annotated[tuple[InterfacePattern, ...], Field(min_length=1), AfterValidator(refuse_duplicates), converted]
        | None
    ) = None
    """Interfaces to use. Without this key, the sidecar uses every ordinary interface that is up, has a link and has an
    address. Loopback, containers, bridges, VPNs and tunnels are used only under their exact name. A glob never matches
    them. If an exact name does not exist, the sidecar logs a warning. It uses the interface as soon as it appears."""
    networks: Annotated[
        tuple[NetworkConfig, ...],
        converted,
        OnlyOn(Role.ROBOT, "it is the robots' interfaces that are chosen between"),
    ] = ()
    """The networks behind the interfaces. The first entry that matches an interface's name applies."""
    region: Annotated[DomainLabel | None, OnlyOn(Role.CLOUD, "a robot's copies should go to different regions")] = None
    """Where the cloud is. Copies of a request go to different regions where possible. The control plane assumes that
    clouds in the same region fail together."""
    udp_port: Annotated[int, Field(ge=0, le=65535)] = Field(
        default_factory=lambda fields: DEFAULT_CLOUD_UDP_PORT if fields.get("role") is Role.CLOUD else 0
    )
    """UDP port of the data sockets, the same on every interface. `0` takes a free port. The default is 0 on a robot and
    24700 on a cloud."""
    advertise: Annotated[
        tuple[AdvertisedAddress, ...], converted, OnlyOn(Role.CLOUD, "a robot's addresses come from STUN")
    ] = ()
    """Public addresses of a 1:1 NAT in front of this host. This key requires a fixed `udp_port`."""
    stun: StunConfig = StunConfig()
    """How the sidecar learns its addresses as seen from outside."""
    state_dir: Annotated[AbsolutePath, converted] = Path("/var/lib/plr")
    """Folder for the sidecar's identity, and for the last good peers and mapping. Each sidecar needs its own folder.
    The sidecar creates a missing folder. The folder, the folders above it, and symbolic links in its path must belong
    to root or to the sidecar's user. If the folder is lost, the sidecar needs the control plane to start. It
    can register its name only after its old lease has ended."""
    max_revocation_age_s: Annotated[int | None, Field(ge=60, le=365 * 86_400)] = None
    """Maximum age of a CA's newest revocation list. The sidecar does not talk to peers whose CA has signed no list
    within this time. It judges by the lists that it has received, and by its own clock. This key requires `tls_dir`.
    Without this key, revocation lists do not age."""
    rekey_after_s: Annotated[int, Field(ge=1, le=86_400)] = 120
    """Age of a path's keys at which both ends agree on new keys. They also do so after 2^21 datagrams. The robot's
    value applies. No traffic waits for new keys."""
    metrics_listen: ListenAddress | None = "127.0.0.1:9464"
    """Where Prometheus reads the metrics. `null` turns this off."""
    local_socket: LocalSocket | None = "auto"
    """Unix socket that `plr doctor` and `plr ping` ask. The path has 101 bytes at most. `null` turns the socket off.
    Root and the sidecar's user may use the socket. Members of the group `plr` use a second socket at the same path with
    `.group` at its end. `auto` means `sidecar.sock` in the runtime folder of the systemd unit (`/run/plr`). If systemd
    does not start the sidecar, `auto` means `sidecar.sock` in `state_dir`."""
    log_level: Annotated[LogLevel, converted] = LogLevel.INFO
    """Lowest level that is logged to stderr."""

    @model_validator(mode="after")
    def _secured_or_not(self) -> Self:
        check_security(self.tls_dir, self.insecure)
        return self

    @property
    def node_name(self) -> NodeName:
        """`name`, typed."""
        return NodeName(self.name)

    @property
    def max_revocation_age(self) -> float:
        """`max_revocation_age_s`; infinite if a list does not age."""
        return math.inf if self.max_revocation_age_s is None else float(self.max_revocation_age_s)

    def local_socket_path(self, runtime_directory: str | None) -> Path | None:
        """Return the path of the local socket; `runtime_directory` is systemd's RUNTIME_DIRECTORY for the unit."""
        if self.local_socket != "auto":
            return None if self.local_socket is None else Path(self.local_socket)
        folder = (runtime_directory or "").partition(":")[0]
        return (Path(folder) if folder else self.state_dir) / "sidecar.sock"

    def service_rules(self) -> tuple[ServiceRule, ...]:
        """Return the services in the form that the cores use, in order."""
        return tuple(service.rule(self.role) for service in self.services)

    def budgets(self) -> tuple[Budget, ...]:
        """Return what extra copies may cost, by interface, in order."""
        return tuple(network.budget() for network in self.networks)

    def labels(self, interfaces: Iterable[InterfaceName]) -> tuple[InterfaceLabel, ...]:
        """Return what is known of these interfaces; those that no entry of `networks` matches are left out."""
        found = []
        for name in dict.fromkeys(interfaces):
            network = self._network(name)
            if network is not None:
                found.append(InterfaceLabel(name, network.carrier or "", network.cost_per_request))
        return tuple(found)

    def price(self, interface: InterfaceName) -> Price:
        """Return the price of the control stream over an interface."""
        network = self._network(interface)
        if network is None:
            return Price(cost_per_request=DEFAULT_COST_PER_REQUEST)
        return Price(network.extra_mb_per_day is not None, network.cost_per_request)

    def _network(self, interface: InterfaceName) -> NetworkConfig | None:
        return next((entry for entry in self.networks if fnmatch.fnmatchcase(interface, entry.interface)), None)


def load_config(path: Path, identify: Callable[[Path], Identity] | None = None) -> SidecarConfig:
    """Read and check the file; raise ConfigError on a problem. `identify` is as in `parse_config`."""
    return parse_config(read_text(path), str(path), identify)


def parse_config(text: str, source: str, identify: Callable[[Path], Identity] | None = None) -> SidecarConfig:
    """Check YAML text; `source` names it in the error. Raises ConfigError.

    `identify` returns whom the certificate in a tls_dir names, or raises ConfigError; without it, the text has to
    contain name and role.
    """
    data = parse_yaml(text, source)
    folder = data.get("tls_dir")
    if identify is not None and isinstance(folder, str):
        try:
            # Checked first: without the certificate in it, name and role would be reported as missing.
            check_absolute(Path(folder))
        except ValueError as error:
            raise ConfigError(source, "tls_dir", str(error)) from error
        data = _with_identity(data, identify(Path(folder)), source)
    config = validate(SidecarConfig, data, source)
    whose = f"; by its certificate this node is a {config.role.value}" if config.tls_dir is not None else ""
    for location, problem in _cross_checks(config):
        raise ConfigError(source, key_path(location), problem + (whose if " only: " in problem else ""))
    return config


def _with_identity(data: dict[str, Any], identity: Identity, source: str) -> dict[str, Any]:
    if identity.role not in (IdentityRole.ROBOT, IdentityRole.CLOUD):
        problem = f"expected the certificate of a robot or a cloud, got that of {identity.name}, {identity.role.value}"
        raise ConfigError(source, "tls_dir", problem)
    known = {"name": identity.name, "role": identity.role.value}
    for key, value in known.items():
        if data.get(key, value) != value:
            raise ConfigError(source, key, f"expected '{value}' as in the certificate, or nothing, got {data[key]!r}")
    return {**data, **known}


def refuse_exposed(config: SidecarConfig, source: str) -> None:
    """Refuse to talk to other machines without TLS; raise ConfigError."""
    exposed = next((address for address in config.control_plane if not is_loopback(address)), None)
    if config.insecure and exposed is not None:
        problem = (
            f"expected a loopback address with insecure: true, got '{exposed}'; use tls_dir, or start "
            "with --insecure-i-know"
        )
        raise ConfigError(source, "control_plane", problem)


def config_schema() -> dict[str, Any]:
    """Return the JSON Schema of the configuration file."""
    schema = SidecarConfig.model_json_schema()
    for section in (schema, *schema["$defs"].values()):
        for key in section.get("properties", {}).values():
            # Editors show the description alone.
            if ROLE_IN_SCHEMA in key:
                key["description"] = f"{key[ROLE_IN_SCHEMA].capitalize()} only. {key['description']}"
    # With tls_dir the certificate holds them.
    schema["required"] = [key for key in schema["required"] if key not in ("name", "role")]
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


_Problem = tuple[tuple[str | int, ...], str]


def _cross_checks(config: SidecarConfig) -> Iterator[_Problem]:
    """Yield problems between fields; a key that would have no effect is refused, not ignored."""
    if config.max_revocation_age_s is not None and config.tls_dir is None:
        yield ("max_revocation_age_s",), "expected beside tls_dir only: nothing is checked in insecure mode"
    for key, problem in config.misplaced(config.role):
        yield (key,), problem
    for index, service in enumerate(config.services):
        for key, problem in service.problems(config.role):
            yield ("services", index, key), problem
    yield from _check_order(config)
    if config.advertise and config.udp_port == 0:
        yield ("udp_port",), "expected a fixed port beside advertise, got 0"
    for index, network in enumerate(config.networks):
        if any(network.interface == before.interface for before in config.networks[:index]):
            yield ("networks", index, "interface"), f"expected each interface once, got '{network.interface}' again"
        elif (winner := _network_before(config.networks[:index], network.interface)) is not None:
            problem = f"expected before '{winner}', which matches '{network.interface}' first"
            yield ("networks", index, "interface"), problem
    for index, advertised in enumerate(config.advertise):
        if advertised.interface is not None and is_glob(advertised.interface):
            yield ("advertise", index, "interface"), f"expected a name, got the glob '{advertised.interface}'"
        if advertised in config.advertise[:index]:
            yield ("advertise", index), "expected each entry once"


def _network_before(earlier: Iterable[NetworkConfig], interface: str) -> str | None:
    """Return the earlier entry that matches an interface first, or all that a glob matches; None if there is none."""
    globs = [network.interface for network in earlier if is_glob(network.interface)]
    if is_glob(interface):
        return _covering(globs, interface)
    return next((glob for glob in globs if fnmatch.fnmatchcase(interface, glob)), None)


def _check_order(config: SidecarConfig) -> Iterator[_Problem]:
    """Find services that are named twice, or that an earlier glob matches first."""
    rules = Rules(config.service_rules())
    names: dict[str, int] = {}
    globs: list[str] = []
    fallbacks: dict[str, int] = {}
    for index, service in enumerate(config.services):
        if service.fallback is not None and fallbacks.setdefault(service.fallback, index) != index:
            yield (
                ("services", index, "fallback"),
                f"expected another than that of services[{fallbacks[service.fallback]}]",
            )
    for index, service in enumerate(config.services):
        name = service.name
        if names.setdefault(name, index) != index:
            yield ("services", index, "name"), f"expected each name once, got '{name}' in services[{names[name]}] too"
            continue
        if name in fallbacks:
            problem = f"expected a service that is not the fallback of services[{fallbacks[name]}]"
            yield ("services", index, "name"), problem
        winner = _covering(globs, name) if is_glob(name) else _winner(rules, name)
        if is_glob(name):
            globs.append(name)
        if winner is not None:
            yield ("services", index, "name"), f"expected before the glob '{winner}', which matches '{name}' first"


def _winner(rules: Rules, name: str) -> str | None:
    """Return the glob that matches a name before its own rule; None if there is none."""
    rule = rules.find(ServiceName(name))
    return None if rule is None or rule.pattern == name else rule.pattern


def _covering(earlier: Iterable[str], glob: str) -> str | None:
    """Return an earlier glob that surely matches all that this one matches: plain text, and one star at its end."""
    for before in earlier:
        beginning = before.removesuffix("*")
        if beginning != before and not is_glob(beginning) and glob.startswith(beginning):
            return before
    return None
