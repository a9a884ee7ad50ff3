"""Reads and checks the configuration of the control plane once; it is then frozen and passed in."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal, Self

from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, model_validator

from plr.controlplane.config.pattern_fields import InterfacePatterns, NodePatterns, OneOrList
from plr.controlplane.config.policy import PolicyConfig
from plr.controlplane.config.section import Section
from plr.controlplane.core.control.events import Settings
from plr.controlplane.core.policy.path_rules import MAX_PATH_RULES, PathRule
from plr.controlplane.core.problem.problem import Objective
from plr.protos.base.errors import ConfigError
from plr.protos.base.host_port import is_loopback
from plr.protos.program.config_fields import (
    AbsolutePath,
    ListenAddress,
    RemoteAddress,
    TlsDir,
    check_security,
    converted,
    refuse_duplicates,
)
from plr.protos.program.config_file import parse_yaml, read_text, validate

if TYPE_CHECKING:
    from pathlib import Path

RECONNECT_MAX_MS = 10_000
"""Longest pause between a sidecar's attempts to reconnect."""


def _empty_if_null(value: object) -> object:
    # "policy:" with nothing after it denies everything. It must not be taken for no policy, which allows everything.
    return {} if value is None else value


class PathRuleConfig(Section):
    """Allows or denies requests over these interfaces of these robots to these clouds."""

    robots: NodePatterns = ("*",)
    """Names of robots."""
    interfaces: InterfacePatterns = ("*",)
    """Names of the robots' interfaces."""
    clouds: NodePatterns = ("*",)
    """Names of clouds."""
    allow: bool
    """Whether mappings may use these pairs."""


class ControlPlaneConfig(Section):
    """Keys of the YAML file. Times are milliseconds unless the key says seconds."""

    model_config = ConfigDict(title="plr-controlplane")

    listen: ListenAddress = "[::]:50051"
    """Where the control plane serves gRPC to sidecars and to `plr`. `[::]` means all addresses, including IPv4. Port 0
    takes a free port."""
    tls_dir: Annotated[TlsDir, converted] | None = None
    """Required without `insecure`. Folder with `cert.pem`, `key.pem`, `ca.pem` and perhaps `crl.pem`.
    `plr ca issue NAME --role controlplane` writes it. The control plane checks the folder four times a second. New
    files, above all a revocation list, take effect without a restart."""
    insecure: bool = False
    """`true` in place of `tls_dir` turns TLS off. Everyone can then claim any name. Use it only for trials on one
    machine. The control plane then refuses a `listen` address that others reach, unless the command line contains
    `--insecure-i-know`."""
    stun_listen: Annotated[
        tuple[ListenAddress, ...], Field(max_length=16, strict=False), OneOrList(), AfterValidator(refuse_duplicates)
    ] = ("[::]:3478",)
    """Where the control plane answers STUN. An empty list turns this off."""
    stun_servers: Annotated[
        tuple[RemoteAddress, ...], Field(max_length=16, strict=False), OneOrList(), AfterValidator(refuse_duplicates)
    ] = ()
    """STUN servers that the sidecars ask. Write the addresses at which the sidecars reach them. They may include this
    host's public address."""
    metrics_listen: ListenAddress | None = "127.0.0.1:9465"
    """Where Prometheus reads the metrics. `null` turns this off."""
    state_dir: Annotated[AbsolutePath, converted] | None = None
    """Folder for the log of events. Each control plane needs its own folder. The control plane creates a missing
    folder. The folder, the folders above it, and symbolic links in its path must belong to root or to the program's
    user. Without this key, the events are in memory only, and a restart forgets which sidecars are gone. The shipped
    configuration sets `/var/lib/plr-controlplane`."""
    lease_ms: Annotated[int, Field(ge=500, le=600_000)] = 5000
    """A sidecar that is silent for this long disappears from its peers' view. The value must be at least three times
    `report_interval_ms`. With a shorter lease, dead servers are forgotten sooner. With a longer lease, slow links are
    not mistaken for dead ones. The sidecars themselves notice dead paths much sooner."""
    report_interval_ms: Annotated[int, Field(ge=50, le=60_000)] = 500
    """Interval at which up to ten sidecars report their measurements. With more sidecars, the interval grows with about
    the square root of their number, up to 10 s. A thousand sidecars report every 6.3 s. A busy control plane lengthens
    the interval, too. A lease lasts for at least three intervals. A changed path or a missed deadline is reported at
    once."""
    warm_up_ms: Annotated[int, Field(ge=0, le=600_000)] = RECONNECT_MAX_MS + 2000
    """Longest time after a start for which the control plane waits for servers to return. During this time, a
    robot that still holds peers does not get a set of peers in which one of its servers is missing."""
    histogram_half_life_s: Annotated[float, Field(ge=1.0, le=86_400.0)] = 60.0
    """Half-life of the latency samples. It is also the half-life of misses in the longest of the memories from which
    misses are predicted. With a shorter half-life, the mapping follows changes sooner, but it rests on fewer
    samples."""
    default_capacity_interfaces: Annotated[int, Field(ge=0, le=256)] = 1
    """How many interfaces of one robot may share a server for one service. `0` means no limit. The FogROS2-PLR paper
    uses 1: every interface has its own server. If servers are too few, the mapping exceeds the limit by as little as
    possible."""
    objective: Annotated[Objective, converted] = Objective.JOINT
    """What the mapping minimises.

    - `joint`: the probability that all copies of a request miss the deadline. It takes into account which paths were
      seen to fail together.
    - `product`: the same probability, as if paths failed independently.
    - `sum`: the sum of the copies' miss probabilities, as in the FogROS2-PLR paper. The worst paths dominate this sum.
      It ignores the probability that all copies miss."""
    solver_time_limit_ms: Annotated[int, Field(ge=10, le=60_000)] = 2000
    """Longest time for one solve. When it ends, the best plan found so far is used. An urgent solve follows when paths
    die or return. Its limit is 0.1 s, or 0.25 ms for each service of each robot if that is longer. Such a solve is
    never longer than this key allows. The next routine solve continues the search."""
    paths: Annotated[tuple[PathRuleConfig, ...], Field(max_length=MAX_PATH_RULES, strict=False)] = ()
    """Rules that say which pairs of an interface and a cloud a mapping may use. The first matching rule applies. A pair
    that no rule matches is allowed. The rules are for planning, not for protection. For protection, use `policy`."""
    policy: Annotated[PolicyConfig | None, BeforeValidator(_empty_if_null)] = None
    """Access control. Without this key, everything is allowed. With this key, everything that no rule allows is denied.
    An empty `policy:` therefore denies everything."""
    log_level: Literal["debug", "info", "warning", "error"] = "info"
    """Lowest level that is logged to stderr."""

    @model_validator(mode="after")
    def _secured_or_not(self) -> Self:
        check_security(self.tls_dir, self.insecure)
        return self

    @model_validator(mode="after")
    def _leases_outlast_reports(self) -> Self:
        if self.lease_ms < 3 * self.report_interval_ms:
            raise ValueError(
                f"lease_ms: expected at least three times report_interval_ms ({self.report_interval_ms}), "
                f"got {self.lease_ms}"
            )
        return self

    def settings(self) -> Settings:
        """Return the core's settings, in seconds."""
        return Settings(
            lease_s=self.lease_ms / 1000,
            report_interval_s=self.report_interval_ms / 1000,
            warm_up_s=self.warm_up_ms / 1000,
            half_life_s=self.histogram_half_life_s,
            default_capacity_interfaces=self.default_capacity_interfaces,
            objective=self.objective,
            stun_servers=self.stun_servers,
            path_rules=tuple(PathRule(rule.robots, rule.interfaces, rule.clouds, rule.allow) for rule in self.paths),
            policy=self.policy.policy() if self.policy is not None else None,
        )


def refuse_exposed(config: ControlPlaneConfig, source: str) -> None:
    """Refuse to serve others without TLS; raises ConfigError."""
    if config.insecure and not is_loopback(config.listen):
        problem = (
            f"expected a loopback address with insecure: true, got '{config.listen}'; use tls_dir, or start with "
            "--insecure-i-know"
        )
        raise ConfigError(source, "listen", problem)


def load_config(path: Path) -> ControlPlaneConfig:
    """Read and check the configuration; raises ConfigError."""
    return parse_config(read_text(path), str(path))


def parse_config(text: str, source: str) -> ControlPlaneConfig:
    """Check YAML text; `source` names it in the error. Raises ConfigError."""
    return validate(ControlPlaneConfig, parse_yaml(text, source), source)
