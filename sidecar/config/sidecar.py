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


class LogLevel(enum.Enum):
    """How much is logged."""

    DEBUG = "debug"
    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


class StunConfig(Section):
    """How the sidecar learns its addresses as seen from outside."""

    enabled: bool = True
    """Turn it off only where no NAT lies between the sidecars, such as clouds with public addresses."""
    servers: Annotated[tuple[RemoteAddress, ...], AfterValidator(refuse_duplicates), converted] = ()
    """STUN servers to ask. An empty list: those named by the control plane, else port 3478 of the control plane's
    host."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.servers and not self.enabled:
            raise ValueError("expected no servers while enabled is false")
        return self


class AdvertisedAddress(Section):
    """A public address that a 1:1 NAT translates to one interface of a cloud."""

    address: IpAddress
    """IPv4 or IPv6 without port: the NAT must keep `udp_port`."""
    interface: Annotated[InterfacePattern, text_of("name")] | None = None
    """Name of the interface behind that address. Without this key it is the first usable one."""


class SidecarConfig(Section):
    """Configuration of plr-sidecar."""

    name: SidecarName
    """Name of this sidecar, unique in the mesh. With `tls_dir` the certificate contains it, and it may be left out
    here. The control plane refuses a second holder. Labels of metrics and `plr status` show it."""
    role: Annotated[Role, converted]
    """What this host does. With `tls_dir` the certificate contains it, and it may be left out here.

    - `robot`: its applications call services.
    - `cloud`: its servers answer them."""
    control_plane: ControlPlaneAddresses
    """Where the control plane listens for gRPC. IPv6 is written in brackets. Every address is tried over every
    interface in use, and the first that answers is taken. An IP address needs no name server, which may lie behind a
    dark carrier."""
    tls_dir: Annotated[TlsDir, converted] | None = None
    """Required without `insecure`. Folder with `cert.pem`, `key.pem`, `ca.pem` and perhaps `crl.pem`, as
    `plr ca issue NAME --role robot` (or `cloud`) writes it. It is checked once a second: with a new certificate the
    sidecar opens a new stream, and requests go on meanwhile."""
    insecure: bool = False
    """`true` in place of `tls_dir`: everybody is who they say, and anyone in between may read and change the traffic.
    This is for trials on one machine: a `control_plane` on another host is refused unless `--insecure-i-know` is on the
    command line."""
    services: Annotated[tuple[ServiceConfig, ...], Field(min_length=1), converted]
    """What is carried, and nothing else. The first entry that matches a name decides."""
    interfaces: (
        Annotated[tuple[InterfacePattern, ...], Field(min_length=1), AfterValidator(refuse_duplicates), converted]
        | None
    ) = None
    """Interfaces to use. Without this key: every ordinary interface that is up and has a carrier and an address.
    Loopback, containers, bridges, VPNs and tunnels are used only under their exact name, never by a glob. An exact name
    that does not exist causes a warning; the interface is used as soon as it comes."""
    networks: Annotated[
        tuple[NetworkConfig, ...],
        converted,
        OnlyOn(Role.ROBOT, "it is the robots' interfaces that are chosen between"),
    ] = ()
    """The networks behind the interfaces. The first entry that matches a name decides."""
    region: Annotated[DomainLabel | None, OnlyOn(Role.CLOUD, "a robot's copies should go to different regions")] = None
    """Where the cloud is. Copies of a request go to different regions where possible: clouds in the same region are
    assumed to fail together."""
    udp_port: Annotated[int, Field(ge=0, le=65535)] = Field(
        default_factory=lambda fields: DEFAULT_CLOUD_UDP_PORT if fields.get("role") is Role.CLOUD else 0
    )
    """Port of the data sockets, the same on every interface. `0` takes a free one. The default is 0 on a robot, 24700
    on a cloud."""
    advertise: Annotated[
        tuple[AdvertisedAddress, ...], converted, OnlyOn(Role.CLOUD, "a robot's addresses come from STUN")
    ] = ()
    """Public addresses of a 1:1 NAT in front of this host. They need a fixed `udp_port`."""
    stun: StunConfig = StunConfig()
    """How the sidecar learns its addresses as seen from outside."""
    state_dir: Annotated[AbsolutePath, converted] = Path("/var/lib/plr")
    """Folder for the sidecar's identity and the last good peers and mapping. Each sidecar has its own; it is made if
    missing. The folder, the folders above it and links on the way must belong to root or the sidecar's user. If the
    folder is lost, the sidecar cannot start without a control plane, and cannot have its name until the old lease
    ends."""
    max_revocation_age_s: Annotated[int | None, Field(ge=60, le=365 * 86_400)] = None
    """The sidecar does not talk to peers whose CA signed no revocation list in this time, as far as is known here and
    by this clock. This needs `tls_dir`. Without this key a list does not age."""
    rekey_after_s: Annotated[int, Field(ge=1, le=86_400)] = 120
    """Age at which a path's ends agree on new keys. They also do so after 2^21 datagrams. The robot's value counts.
    Nothing waits for it."""
    metrics_listen: ListenAddress | None = "127.0.0.1:9464"
    """Where Prometheus reads the metrics; `null` for none."""
    local_socket: LocalSocket | None = "auto"
    """Unix socket that `plr doctor` and `plr ping` ask, 101 bytes at most; `null` for none. Root and the sidecar's user
    may use it; the group `plr` uses the same path with `.group` at its end. `auto` is `sidecar.sock` in the unit's
    runtime folder (`/run/plr`), or in `state_dir` where systemd does not start the sidecar."""
    log_level: Annotated[LogLevel, converted] = LogLevel.INFO
    """Least level of what is logged to stderr."""

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
        yield from _check_order(config, index)
    if config.advertise and config.udp_port == 0:
        yield ("udp_port",), "expected a fixed port beside advertise, got 0"
    for index, network in enumerate(config.networks):
        if any(network.interface == before.interface for before in config.networks[:index]):
            yield ("networks", index, "interface"), f"expected each interface once, got '{network.interface}' again"
    for index, advertised in enumerate(config.advertise):
        if advertised.interface is not None and is_glob(advertised.interface):
            yield ("advertise", index, "interface"), f"expected a name, got the glob '{advertised.interface}'"
        if advertised in config.advertise[:index]:
            yield ("advertise", index), "expected each entry once"


def _check_order(config: SidecarConfig, index: int) -> Iterator[_Problem]:
    name = config.services[index].name
    for before, service in enumerate(config.services[:index]):
        if service.name == name:
            yield (
                ("services", index, "name"),
                f"expected each name once, got '{name}' in services[{before}] too",
            )
        if service.fallback is not None and service.fallback == config.services[index].fallback:
            yield ("services", index, "fallback"), f"expected another than that of services[{before}]"
    for other, service in enumerate(config.services):
        if service.fallback == name:
            yield ("services", index, "name"), f"expected a service that is not the fallback of services[{other}]"
    if not is_glob(name):
        winner = Rules(config.service_rules()[:index]).find(ServiceName(name))
        if winner is not None and winner.pattern != name:
            yield (
                ("services", index, "name"),
                f"expected before the glob '{winner.pattern}', which matches '{name}' first",
            )
