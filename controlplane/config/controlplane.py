"""Reads and checks the configuration of the control plane once; it is then frozen and passed in."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal, Self

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from plr.controlplane.config.pattern_fields import InterfacePatterns, NodePatterns, one_or_list
from plr.controlplane.config.policy import PolicyConfig
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


class PathRuleConfig(BaseModel):
    """Allows or denies requests over these interfaces of these robots to these clouds."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    robots: NodePatterns = Field(default=("*",), description="Patterns of names of robots.")
    interfaces: InterfacePatterns = Field(default=("*",), description="Patterns of names of the robots' interfaces.")
    clouds: NodePatterns = Field(default=("*",), description="Patterns of names of clouds.")
    allow: bool = Field(description="Whether mappings may use these pairs.")


class ControlPlaneConfig(BaseModel):
    """Keys of the YAML file. Times are milliseconds unless the key says seconds."""

    model_config = ConfigDict(frozen=True, extra="forbid", title="plr-controlplane")

    listen: ListenAddress = Field(
        default="[::]:50051", description="address:port of the gRPC server; port 0 takes a free one."
    )
    tls_dir: TlsDir | None = Field(
        default=None,
        description="Absolute path of the folder with cert.pem, key.pem, ca.pem and perhaps crl.pem, as plr ca issue "
        "writes it; read anew when they change. Required unless insecure.",
    )
    insecure: bool = Field(
        default=False,
        description="true: no TLS, everybody is who they say. For trying out on one machine; refused with a listen "
        "address that others reach, unless --insecure-i-know is on the command line.",
    )
    stun_listen: Annotated[
        tuple[ListenAddress, ...], BeforeValidator(one_or_list), AfterValidator(refuse_duplicates), Field(max_length=16)
    ] = Field(
        default=("[::]:3478",),
        description="address:port or a list of them where STUN is answered; an empty list turns it off. "
        "[::] means all addresses, IPv4 included.",
    )
    stun_servers: Annotated[
        tuple[RemoteAddress, ...], BeforeValidator(one_or_list), AfterValidator(refuse_duplicates), Field(max_length=16)
    ] = Field(
        default=(),
        description="host:port of the STUN servers that sidecars are told to use, seen from the sidecars: "
        "this one's public address, others, or both.",
    )
    metrics_listen: ListenAddress | None = Field(
        default="127.0.0.1:9465", description="address:port for Prometheus; null turns it off."
    )
    state_dir: AbsolutePath | None = Field(
        default=None,
        description="Absolute path of a folder of its own, made if missing, for the log of events; null keeps these in "
        "memory only, where a restart forgets who is gone.",
    )
    lease_ms: int = Field(
        default=5000,
        ge=500,
        le=600_000,
        description="A sidecar silent for this long leaves its peers' view. Ten reports long: a cellular "
        "handover or a lost TCP segment takes seconds, and dead paths are noticed by the data plane much sooner.",
    )
    report_interval_ms: int = Field(
        default=500,
        ge=50,
        le=60_000,
        description="How often ten sidecars report what they measured; more of them less often, up to 10 s "
        "apart. What cannot wait they report at once.",
    )
    warm_up_ms: int = Field(
        default=RECONNECT_MAX_MS + 2000,
        ge=0,
        le=600_000,
        description="After a start, robots that still hold peers are not sent a set that lacks some for at most "
        f"this long: sidecars come back within {RECONNECT_MAX_MS} ms, and the time to register.",
    )
    histogram_half_life_s: float = Field(
        default=60.0, ge=1.0, le=86_400.0, description="Age at which a latency sample counts half."
    )
    default_capacity_interfaces: int = Field(
        default=1,
        ge=0,
        le=256,
        description="How many interfaces of one robot may share a server for one service; 0 means no limit. The "
        "paper's value is 1. Exceeded by the least amount where there are too few servers.",
    )
    objective: Objective = Field(
        default=Objective.JOINT,
        description="What the mapping minimises: the probability that all copies miss the deadline, with paths that "
        "fail together (joint) or as if they never did (product), or the sum of the copies' miss probabilities "
        "(sum, the paper's).",
    )
    solver_time_limit_ms: int = Field(
        default=2000, ge=10, le=60_000, description="Longest time for one solving; then the best plan found is taken."
    )
    paths: tuple[PathRuleConfig, ...] = Field(
        default=(),
        max_length=MAX_PATH_RULES,
        description="Which pairs of an interface and a cloud mappings may use: the first rule that matches decides, "
        "and what none matches is allowed.",
    )
    policy: Annotated[PolicyConfig | None, BeforeValidator(_empty_if_null)] = Field(
        default=None,
        description="Access control. Without this key everything is allowed; with it, what no rule allows is denied.",
    )
    log_level: Literal["debug", "info", "warning", "error"] = Field(default="info", description="Least level logged.")

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
