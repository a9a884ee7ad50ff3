"""Configuration of the control plane: read and checked once, then frozen and passed in."""

from __future__ import annotations

import ipaddress
import re
from typing import TYPE_CHECKING, Annotated, Literal, Self

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from controlplane import config_file
from controlplane.core.control_events import Settings

if TYPE_CHECKING:
    from pathlib import Path

RECONNECT_MAX_MS = 10_000
"""Sidecars try again at most this far apart."""

_LABEL = r"[A-Za-z0-9_]([A-Za-z0-9_-]*[A-Za-z0-9_])?"
_HOST = re.compile(rf"(?=.{{1,253}}$){_LABEL}(\.{_LABEL})*")


def split_host_port(text: str) -> tuple[str, int]:
    """Split host:port, IPv6 in brackets; raises ValueError that says what was expected."""
    host, _, port = text.rpartition(":")
    if not re.fullmatch(r"[0-9]{1,5}", port) or int(port) > 65535:
        raise ValueError(f"expected host:port, got {text!r}")
    if host.startswith("[") and host.endswith("]"):
        try:
            return str(ipaddress.IPv6Address(host[1:-1])), int(port)
        except ipaddress.AddressValueError:
            raise ValueError(f"expected an IPv6 address in the brackets, got {text!r}") from None
    if not _HOST.fullmatch(host):
        raise ValueError(f"expected host:port with a name, IPv4 or [IPv6] address, got {text!r}")
    return host, int(port)


def _listen(text: str) -> str:
    split_host_port(text)
    return text


def check_target(text: str) -> str:
    """Check host:port of a server to connect to; raises ValueError that says what was expected."""
    host, port = split_host_port(text)
    if port == 0:
        raise ValueError(f"expected a port from 1 to 65535, got {text!r}")
    if host in ("0.0.0.0", "::"):  # noqa: S104 - refused, not listened on
        raise ValueError(f"expected an address that sidecars can reach, got {text!r}")
    return text


def _as_list(value: object) -> object:
    return (value,) if isinstance(value, str) else value


def _each_once(values: tuple[str, ...]) -> tuple[str, ...]:
    for index, value in enumerate(values):
        if value in values[:index]:
            raise ValueError(f"expected each entry once, got {value!r} twice")
    return values


Listen = Annotated[str, AfterValidator(_listen)]
Target = Annotated[str, AfterValidator(check_target)]


class ControlPlaneConfig(BaseModel):
    """Keys of the YAML file. Times are milliseconds unless the key says seconds."""

    model_config = ConfigDict(frozen=True, extra="forbid", title="plr-controlplane")

    listen: Listen = Field(default="[::]:50051", description="host:port of the gRPC server; port 0 takes a free one.")
    stun_listen: Annotated[
        tuple[Listen, ...], BeforeValidator(_as_list), AfterValidator(_each_once), Field(max_length=16)
    ] = Field(
        default=("[::]:3478",),
        description="host:port or a list of them where STUN is answered; an empty list turns it off. "
        "[::] means all addresses, IPv4 included.",
    )
    stun_servers: Annotated[
        tuple[Target, ...], BeforeValidator(_as_list), AfterValidator(_each_once), Field(max_length=16)
    ] = Field(
        default=(),
        description="host:port of the STUN servers that sidecars are told to use, seen from the sidecars: "
        "this one's public address, others, or both.",
    )
    metrics_listen: Listen | None = Field(
        default="127.0.0.1:9465", description="host:port for Prometheus; null turns it off."
    )
    lease_ms: int = Field(
        default=5000,
        ge=500,
        le=600_000,
        description="A sidecar silent for this long leaves its peers' view. Ten reports long: a cellular "
        "handover or a lost TCP segment takes seconds, and dead paths are noticed by the data plane much sooner.",
    )
    report_interval_ms: int = Field(
        default=500, ge=50, le=60_000, description="How often sidecars report what they measured."
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
    solver_time_limit_ms: int = Field(
        default=2000, ge=10, le=60_000, description="Longest time for one solving; then the best plan found is taken."
    )
    log_level: Literal["debug", "info", "warning", "error"] = Field(default="info", description="Least level logged.")

    @model_validator(mode="after")
    def _leases_outlast_reports(self) -> Self:
        if self.lease_ms < 3 * self.report_interval_ms:
            raise ValueError(
                f"lease_ms: expected at least three times report_interval_ms ({self.report_interval_ms}), "
                f"got {self.lease_ms}"
            )
        return self

    def settings(self) -> Settings:
        """What the core needs of it, in seconds."""
        return Settings(
            lease_s=self.lease_ms / 1000,
            report_interval_s=self.report_interval_ms / 1000,
            warm_up_s=self.warm_up_ms / 1000,
            half_life_s=self.histogram_half_life_s,
            default_capacity_interfaces=self.default_capacity_interfaces,
            stun_servers=self.stun_servers,
        )


def load_config(path: Path) -> ControlPlaneConfig:
    """Read and check the configuration; raises ConfigError."""
    return config_file.load(ControlPlaneConfig, path)
