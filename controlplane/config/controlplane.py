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
    """Where gRPC is served, for sidecars and `plr`. `[::]` means all addresses, IPv4 included; port 0 takes a free
    one."""
    tls_dir: Annotated[TlsDir, converted] | None = None
    """Required without `insecure`. Folder with `cert.pem`, `key.pem`, `ca.pem` and perhaps `crl.pem`, as
    `plr ca issue NAME --role controlplane` writes it. It is checked four times a second: new files, above all a
    revocation list, take effect without a restart."""
    insecure: bool = False
    """`true` in place of `tls_dir`: no TLS, and everybody is who they say. This is for trials on one machine: a
    `listen` address that others reach is refused unless `--insecure-i-know` is on the command line."""
    stun_listen: Annotated[
        tuple[ListenAddress, ...], Field(max_length=16, strict=False), OneOrList(), AfterValidator(refuse_duplicates)
    ] = ("[::]:3478",)
    """Where STUN is answered. An empty list turns it off."""
    stun_servers: Annotated[
        tuple[RemoteAddress, ...], Field(max_length=16, strict=False), OneOrList(), AfterValidator(refuse_duplicates)
    ] = ()
    """STUN servers for the sidecars to ask, as seen from them: this host's public address, others, or both."""
    metrics_listen: ListenAddress | None = "127.0.0.1:9465"
    """Where Prometheus reads the metrics; `null` for none."""
    state_dir: Annotated[AbsolutePath, converted] | None = None
    """Folder for the log of events, one for each control plane; it is made if missing. The folder, the folders above it
    and links on the way must belong to root or the program's user. Without this key events are in memory only, and a
    restart forgets who is gone. The shipped configuration sets `/var/lib/plr-controlplane`."""
    lease_ms: Annotated[int, Field(ge=500, le=600_000)] = 5000
    """A sidecar silent for this long leaves its peers' view. It is at least three `report_interval_ms`. With a shorter
    one, dead servers are forgotten sooner; with a longer one, slow links are not mistaken for dead ones. The sidecars
    themselves notice dead paths much sooner."""
    report_interval_ms: Annotated[int, Field(ge=50, le=60_000)] = 500
    """How often ten sidecars report what they measured. More sidecars report less often, by about the square root of
    their number and up to 10 s apart: a thousand every 6.3 s. Their leases are at least three reports long. A changed
    path or a missed deadline is reported at once."""
    warm_up_ms: Annotated[int, Field(ge=0, le=600_000)] = RECONNECT_MAX_MS + 2000
    """After a start, for at most this long, a robot that still holds peers is not sent a set that lacks some of its
    servers: they may just not be back yet."""
    histogram_half_life_s: Annotated[float, Field(ge=1.0, le=86_400.0)] = 60.0
    """Half-life of latency samples, and of misses in the longest of the memories that predict. With a shorter one, the
    mapping follows sooner and rests on fewer samples."""
    default_capacity_interfaces: Annotated[int, Field(ge=0, le=256)] = 1
    """How many interfaces of one robot may share a server for one service; `0` for no limit. 1 is the paper's value:
    every interface has its own server. The limit is exceeded by the least amount where servers are too few."""
    objective: Annotated[Objective, converted] = Objective.JOINT
    """What the mapping minimises.

    - `joint`: the probability that all copies of a request miss the deadline, with paths that were seen to fail
      together counted as such.
    - `product`: the same as if paths failed independently.
    - `sum`: the sum of the copies' miss probabilities, as in the paper. It looks at the bad paths first, and ignores
      how bad all are together."""
    solver_time_limit_ms: Annotated[int, Field(ge=10, le=60_000)] = 2000
    """Longest time for one solve; then the incumbent is taken. An urgent solve, after paths died or came back, is
    limited to 0.1 s, or to 0.25 ms for each service of a robot if that is longer. The next routine solve goes on."""
    paths: Annotated[tuple[PathRuleConfig, ...], Field(max_length=MAX_PATH_RULES, strict=False)] = ()
    """Rules on which pairs of an interface and a cloud mappings may use. The first that matches decides; what none
    matches is allowed. They are for planning, not for protection, which is the task of `policy`."""
    policy: Annotated[PolicyConfig | None, BeforeValidator(_empty_if_null)] = None
    """Access control. Without this key everything is allowed. With it, even with nothing after it, what no rule allows
    is denied."""
    log_level: Literal["debug", "info", "warning", "error"] = "info"
    """Least level of what is logged to stderr."""

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
