"""The sidecar's configuration: one YAML file, validated once, frozen, passed in."""

from __future__ import annotations

import enum
import fnmatch
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from protos.config_fields import (
    IpAddress,
    ListenAddress,
    RemoteAddress,
    TlsDir,
    check_security,
    is_loopback,
    refuse_duplicates,
)
from protos.config_file import key_path, parse_yaml, read_text, validate
from protos.convert.fields import MAX_CHARGE
from protos.errors import ConfigError
from protos.identity import IdentityRole
from protos.model import (
    AT_MOST_EVERY_INTERFACE,
    DEFAULT_CHARGE,
    EVERY_INTERFACE,
    InterfaceLabel,
    NodeName,
    Role,
    ServiceName,
)
from sidecar.config_fields import (
    CopiesWanted,
    DomainLabel,
    InterfacePattern,
    RepairShare,
    ServicePattern,
    SidecarName,
    is_glob,
)
from sidecar.core.priority import Priority
from sidecar.core.rules import MAX_LIFETIME_S, ServiceRule, find_rule

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from protos.identity import Identity
    from protos.model import InterfaceName
    from sidecar.core.redundancy import Redundancy

DEFAULT_CLOUD_UDP_PORT = 24700
"""Fixed, since a firewall rule has to name it; below Linux' ephemeral ports (32768 and up)."""

MAX_DEADLINE_MS = 60_000
"""Where the latency histogram ends: a miss of a longer deadline could not be predicted."""

MIN_DEFAULT_LIFETIME_MS = 10_000.0
"""A request outlives its deadline at least until a dead path is noticed and another one has tried."""

LIFETIME_PER_DEADLINE = 10.0
"""Default lifetime, in deadlines."""

CLOUD_LIFETIME_MS = 60_000.0
"""How long a cloud sidecar waits for a local server by default."""

_UNLIMITED = 0
_MS_PER_S = 1000.0
_MAX_LIFETIME_MS = MAX_LIFETIME_S * _MS_PER_S

# A YAML list becomes a tuple, a word an enum: strictness would refuse both. What the list holds stays strict.
_converted = Field(strict=False)


class LogLevel(enum.Enum):
    """How much is logged."""

    DEBUG = "debug"
    INFO = "info"
    WARNING = "warning"
    ERROR = "error"


class PriorityWord(enum.Enum):
    """Which of a robot's services go first."""

    LOW = "low"
    NORMAL = "normal"
    HIGH = "high"


class _Section(BaseModel):
    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


class ModeWord(enum.Enum):
    """What a service's mapping is chosen for."""

    MOST_RELIABLE = "most_reliable"
    CHEAPEST = "cheapest"


class StunConfig(_Section):
    """How the sidecar learns its addresses as seen from outside."""

    enabled: bool = True
    """Off only where no NAT lies between the sidecars, such as clouds with public addresses."""
    servers: Annotated[tuple[RemoteAddress, ...], AfterValidator(refuse_duplicates), _converted] = ()
    """host:port of each server; none: those that the control plane names."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.servers and not self.enabled:
            raise ValueError("expected no servers while enabled is false")
        return self


class AdvertisedAddress(_Section):
    """A public address that a 1:1 NAT translates to one interface of a cloud."""

    address: IpAddress
    """IPv4 or IPv6, without port: the NAT keeps udp_port."""
    interface: InterfacePattern | None = None
    """The interface behind it; none: the first usable one."""


class NetworkConfig(_Section):
    """What lies behind interfaces; the first entry that matches an interface's name decides."""

    interface: InterfacePattern
    """Name or glob."""
    carrier: DomainLabel | None = None
    """Whose network it is: interfaces with the same carrier are taken to fail together."""
    cost_per_request: Annotated[float, Field(ge=0, le=MAX_CHARGE)] = DEFAULT_CHARGE
    """What a copy of a request over it costs, in any one currency; for services with mode cheapest."""


class ServiceConfig(_Section):
    """One service, or all whose name matches a glob; the first entry that matches a name decides."""

    name: ServicePattern
    """Full name such as /plan_path, or a glob such as /arm/*."""
    deadline_ms: Annotated[float, Field(gt=0, le=MAX_DEADLINE_MS)] | None = None
    """Robot, required: an answer is in time within this many milliseconds."""
    lifetime_ms: Annotated[float, Field(gt=0, le=_MAX_LIFETIME_MS)] | None = None
    """Milliseconds after which an unanswered request is given up; more than deadline_ms.

    Robot: by default 10 deadlines, between 10000 and 300000. Cloud: how long a local server is waited for, by default
    60000."""
    idempotent: bool | None = None
    """Robot: copies of one request may run on several servers. Default false."""
    drop_late: bool | None = None
    """Robot: an answer after the deadline is not delivered. Default false."""
    priority: Annotated[PriorityWord | None, _converted] = None
    """Robot: low, normal or high; what is higher never waits for what is lower. Default normal."""
    fec: RepairShare | None = None
    """Repair symbols for each symbol of what is sent from here (robot: requests, cloud: answers), 0 to 1, or off, or
    auto: as many as the loss measured on the path asks for. Default auto."""
    copies: CopiesWanted | None = None
    """Robot: over how many interfaces copies of a request are sent: each, at_most (each, but rather none than one too
    many for a server or into a failure domain already used), or a number. Default each; with mode cheapest at_most."""
    mode: Annotated[ModeWord | None, _converted] = None
    """Robot: most_reliable or cheapest, as long as target_miss is kept. Default most_reliable."""
    target_miss: Annotated[float, Field(gt=0, lt=1)] | None = None
    """Robot, with mode cheapest: the largest predicted probability that a request misses its deadline."""
    capacity_interfaces: Annotated[int, Field(ge=1, le=1_000_000)] | None = None
    """Cloud: how many robot interfaces may be mapped to this server for the service; none: no limit."""
    cost_per_request: Annotated[float, Field(ge=0, le=MAX_CHARGE)] | None = None
    """Cloud: what a request costs that runs here, in the currency of the robots' networks. Default 0."""


class SidecarConfig(_Section):
    """Configuration of plr-sidecar."""

    name: SidecarName
    """Name of this sidecar, unique in the mesh. With tls_dir the certificate's, and may be left out."""
    role: Annotated[Role, _converted]
    """robot: its applications call services; cloud: its servers answer them. With tls_dir the certificate's, and may
    be left out."""
    control_plane: RemoteAddress
    """host:port of the control plane."""
    tls_dir: Annotated[TlsDir, _converted] | None = None
    """Absolute path of the folder with cert.pem, key.pem, ca.pem and perhaps crl.pem, as plr ca issue writes it; read
    anew when they change. Required unless insecure."""
    insecure: bool = False
    """true: everybody is who they say. For trying out on one machine; refused with a control_plane elsewhere, unless
    --insecure-i-know is on the command line."""
    services: Annotated[tuple[ServiceConfig, ...], Field(min_length=1), _converted]
    """What is carried; nothing else is."""
    interfaces: (
        Annotated[tuple[InterfacePattern, ...], Field(min_length=1), AfterValidator(refuse_duplicates), _converted]
        | None
    ) = None
    """Names or globs; none: all usable ones, which leaves out loopback, containers, bridges and tunnels."""
    networks: Annotated[tuple[NetworkConfig, ...], _converted] = ()
    """Robot: carriers and costs of its interfaces."""
    region: DomainLabel | None = None
    """Cloud: where it stands: clouds in the same region are taken to fail together."""
    udp_port: Annotated[int, Field(ge=0, le=65535)] = Field(
        default_factory=lambda fields: DEFAULT_CLOUD_UDP_PORT if fields.get("role") is Role.CLOUD else 0
    )
    """Port of the data sockets, 0 for any free one. Default: 0 on a robot, 24700 on a cloud."""
    advertise: Annotated[tuple[AdvertisedAddress, ...], _converted] = ()
    """Cloud behind a 1:1 NAT: its public addresses."""
    stun: StunConfig = StunConfig()
    """How the sidecar learns its addresses as seen from outside."""
    state_dir: Annotated[Path, _converted] = Path("/var/lib/plr")
    """Absolute path of the folder for the identity and the last good mapping."""
    rekey_after_s: Annotated[int, Field(ge=1, le=86_400)] = 3600
    """Seconds after which the keys that seal datagrams are changed; their volume changes them as well."""
    metrics_listen: ListenAddress | None = "127.0.0.1:9464"
    """address:port of the Prometheus metrics; null for none."""
    log_level: Annotated[LogLevel, _converted] = LogLevel.INFO
    """debug, info, warning or error."""

    @model_validator(mode="after")
    def _secured_or_not(self) -> Self:
        check_security(self.tls_dir, self.insecure)
        return self

    @property
    def node_name(self) -> NodeName:
        """`name`, typed."""
        return NodeName(self.name)

    def service_rules(self) -> tuple[ServiceRule, ...]:
        """The services as the cores want them, in order."""
        return tuple(_rule(self.role, service) for service in self.services)

    def labels(self, interfaces: Iterable[InterfaceName]) -> tuple[InterfaceLabel, ...]:
        """What is known of these interfaces; those that no entry of `networks` matches are left out."""
        found = []
        for name in dict.fromkeys(interfaces):
            network = next((entry for entry in self.networks if fnmatch.fnmatchcase(name, entry.interface)), None)
            if network is not None:
                found.append(InterfaceLabel(name, network.carrier or "", network.cost_per_request))
        return tuple(found)


def load_config(path: Path, identify: Callable[[Path], Identity] | None = None) -> SidecarConfig:
    """Read and check the file; raises ConfigError. `identify` as of `parse_config`."""
    return parse_config(read_text(path), str(path), identify)


def parse_config(text: str, source: str, identify: Callable[[Path], Identity] | None = None) -> SidecarConfig:
    """Check YAML text; `source` names it in the error. Raises ConfigError.

    `identify` tells (or raises ConfigError) whom the certificate in a tls_dir names; without it name and role have to
    stand in the text.
    """
    data = parse_yaml(text, source)
    folder = data.get("tls_dir")
    if identify is not None and isinstance(folder, str):
        if not Path(folder).is_absolute():
            # Before name and role are missed that stand in there.
            raise ConfigError(source, "tls_dir", f"expected an absolute path, got '{folder}'")
        data = _with_identity(data, identify(Path(folder)), source)
    config = validate(SidecarConfig, data, source)
    for location, problem in _cross_checks(config):
        raise ConfigError(source, key_path(location), problem)
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
    """Refuse to talk to others without TLS; raises ConfigError."""
    if config.insecure and not is_loopback(config.control_plane):
        problem = (
            f"expected a loopback address with insecure: true, got '{config.control_plane}'; use tls_dir, or start "
            "with --insecure-i-know"
        )
        raise ConfigError(source, "control_plane", problem)


def config_schema() -> dict[str, Any]:
    """Return the JSON Schema of the configuration file."""
    schema = SidecarConfig.model_json_schema()
    # With tls_dir the certificate has them.
    schema["required"] = [key for key in schema["required"] if key not in ("name", "role")]
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def _redundancy(fec: float | str | None) -> Redundancy:
    if fec == "off":
        return 0.0
    return None if isinstance(fec, str) else fec


def _rule(role: Role, service: ServiceConfig) -> ServiceRule:
    if role is Role.CLOUD:
        lifetime_ms = service.lifetime_ms or CLOUD_LIFETIME_MS
        deadline_ms = lifetime_ms
    else:
        deadline_ms = service.deadline_ms or MAX_DEADLINE_MS
        default_ms = min(max(LIFETIME_PER_DEADLINE * deadline_ms, MIN_DEFAULT_LIFETIME_MS), _MAX_LIFETIME_MS)
        lifetime_ms = service.lifetime_ms or default_ms
    return ServiceRule(
        pattern=service.name,
        deadline_s=deadline_ms / _MS_PER_S,
        lifetime_s=lifetime_ms / _MS_PER_S,
        idempotent=bool(service.idempotent),
        drop_late=bool(service.drop_late),
        priority=Priority[(service.priority or PriorityWord.NORMAL).name],
        fec=_redundancy(service.fec),
        capacity=service.capacity_interfaces or _UNLIMITED,
        copies=service.copies or (AT_MOST_EVERY_INTERFACE if service.target_miss else EVERY_INTERFACE),
        target_miss=service.target_miss or 0.0,
        charge=service.cost_per_request or 0.0,
    )


_Problem = tuple[tuple[str | int, ...], str]


def _cross_checks(config: SidecarConfig) -> Iterator[_Problem]:
    """Yield what single fields cannot know; a key that would have no effect is refused, not ignored."""
    if not config.state_dir.is_absolute():
        yield ("state_dir",), f"expected an absolute path, got '{config.state_dir}'"
    for index, service in enumerate(config.services):
        for key, problem in _check_service(config.role, service):
            yield ("services", index, key), problem
        yield from _check_order(config, index)
    if config.advertise and config.role is Role.ROBOT:
        yield ("advertise",), "expected on a cloud only: a robot's addresses come from STUN"
    if config.advertise and config.udp_port == 0:
        yield ("udp_port",), "expected a fixed port beside advertise, got 0"
    if config.networks and config.role is Role.CLOUD:
        yield ("networks",), "expected on a robot only: it is the robots' interfaces that are chosen between"
    if config.region is not None and config.role is Role.ROBOT:
        yield ("region",), "expected on a cloud only: a robot's copies should go to different regions"
    for index, network in enumerate(config.networks):
        if any(network.interface == before.interface for before in config.networks[:index]):
            yield ("networks", index, "interface"), f"expected each interface once, got '{network.interface}' again"
    for index, advertised in enumerate(config.advertise):
        if advertised.interface is not None and is_glob(advertised.interface):
            yield ("advertise", index, "interface"), f"expected a name, got the glob '{advertised.interface}'"
        if advertised in config.advertise[:index]:
            yield ("advertise", index), "expected each entry once"


def _check_service(role: Role, service: ServiceConfig) -> Iterator[tuple[str, str]]:
    if role is Role.CLOUD:
        for key in ("deadline_ms", "idempotent", "drop_late", "priority", "copies", "mode", "target_miss"):
            if getattr(service, key) is not None:
                yield key, "expected on a robot only: it is the robot's sidecar that decides this"
        return
    if service.capacity_interfaces is not None:
        yield "capacity_interfaces", "expected on a cloud only: it limits what that server takes"
    if service.cost_per_request is not None:
        yield "cost_per_request", "expected on a cloud only: a robot's costs are its networks'"
    if service.mode is ModeWord.CHEAPEST and service.target_miss is None:
        yield "target_miss", "expected a probability beside mode: cheapest, but missing"
    if service.mode is not ModeWord.CHEAPEST and service.target_miss is not None:
        yield "target_miss", "expected only beside mode: cheapest"
    if service.deadline_ms is None:
        yield "deadline_ms", "expected milliseconds, but missing"
    elif service.lifetime_ms is not None and service.lifetime_ms <= service.deadline_ms:
        yield (
            "lifetime_ms",
            f"expected more than deadline_ms ({service.deadline_ms:g}), got {service.lifetime_ms:g}",
        )


def _check_order(config: SidecarConfig, index: int) -> Iterator[_Problem]:
    name = config.services[index].name
    for before, service in enumerate(config.services[:index]):
        if service.name == name:
            yield (
                ("services", index, "name"),
                f"expected each name once, got '{name}' in services[{before}] too",
            )
    if not is_glob(name):
        winner = find_rule(config.service_rules()[:index], ServiceName(name))
        if winner is not None and winner.pattern != name:
            yield (
                ("services", index, "name"),
                f"expected before the glob '{winner.pattern}', which matches '{name}' first",
            )
