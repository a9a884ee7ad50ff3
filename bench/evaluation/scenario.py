"""Scenarios: what is asked over which two paths, read from the YAML files of a folder.

name: drive              # what it is called, with the seed or the trace's name after it
case: A                  # case study of docs/develop/evaluation.md
about: one line for people
duration_s: 120
traffic: {request_bytes: 120000, answer_bytes: 1000, rate_hz: 5, deadline_ms: 1000, compute_ms: 20}
network: {generator: drive, seeds: [1, 2]}              # made up, or
network: {traces: "drive-*", of_each_family: 4}         # recorded: windows by the rule of `windows.py`
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from bench.evaluation.generator import generate
from bench.evaluation.kinds import KINDS
from bench.evaluation.windows import Window, choose
from protos.program.config_file import parse_yaml, read_text, validate

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from lab import Trace
    from lab.trace_folder import TraceEntry

FOLDER = Path(__file__).with_name("scenarios")
HEADER_BYTES = 16
"""The smallest request and answer: what a contender needs to tell one from another."""


def _known_kind(name: str) -> str:
    if name not in KINDS:
        raise ValueError(f"expected one of {', '.join(KINDS)}")
    return name


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Traffic(_Section):
    """What is asked."""

    request_bytes: Annotated[int, Field(ge=HEADER_BYTES, le=10_000_000)]
    answer_bytes: Annotated[int, Field(ge=HEADER_BYTES, le=10_000_000)]
    rate_hz: Annotated[float, Field(gt=0, le=1000)]
    deadline_ms: Annotated[float, Field(gt=0, le=10_000)]
    compute_ms: Annotated[float, Field(ge=0, le=10_000)]
    """How long a server takes for each request, one at a time."""
    stall_ms: Annotated[float, Field(ge=0, le=60_000)] = 0.0
    """How much longer the first server, that of carrier a where each has its own, takes now and then ..."""
    stall_every: Annotated[int, Field(ge=0)] = 0
    """... namely for every so-manieth request; 0: never."""

    def compute(self, *, first: bool) -> dict[str, Any]:
        """Arguments of `bench.dataplane.calling.Compute`, for the first or any other server."""
        stall_s, every = (self.stall_ms / 1e3, self.stall_every) if first else (0.0, 0)
        return {"compute_s": self.compute_ms / 1e3, "stall_s": stall_s, "stall_every": every}


class _Network(_Section):
    generator: Annotated[str, AfterValidator(_known_kind)] | None = None
    seeds: Annotated[tuple[int, ...], Field(min_length=1)] = (1,)
    traces: str | None = None
    """Glob of names."""
    of_each_family: Annotated[int, Field(ge=1)] = 1

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if (self.generator is None) == (self.traces is None):
            raise ValueError("expected either generator or traces")
        return self


class ScenarioFile(_Section):
    """One file."""

    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9-]{0,40}$")]
    case: Literal["A", "B", "C", "D", "E", "F", "G"]
    about: str
    duration_s: Annotated[float, Field(ge=5, le=3600)] = 120.0
    traffic: Traffic
    network: _Network


@dataclass(frozen=True, slots=True)
class Scenario:
    """One window of one network, and what is asked in it."""

    name: str
    case: str
    about: str
    duration_s: float
    traffic: Traffic
    kind: str | None = None
    """Of the generator; None: recorded."""
    seed: int = 0
    window: Window | None = None
    """Of a recorded trace."""

    @property
    def count(self) -> int:
        """Requests in the window; number k is due at k / rate_hz."""
        return int(self.duration_s * self.traffic.rate_hz)

    def trace(self) -> Trace:
        """The window's trace, its clock beginning with the window. Raises LabConfigError: not readable."""
        if self.window is not None:
            return self.window.load()
        assert self.kind is not None
        return generate(self.kind, self.seed, self.duration_s)

    def shortened(self, duration_s: float) -> Scenario:
        """At most this long: a shorter generated window, the middle of a recorded one; another name, if shorter."""
        if duration_s >= self.duration_s:
            return self
        window = None if self.window is None else self.window.middle(duration_s)
        return replace(self, name=f"{self.name}-{duration_s:g}s", duration_s=duration_s, window=window)


def read_scenarios(traces: Sequence[TraceEntry], folder: Path = FOLDER) -> list[Scenario]:
    """All scenarios of a folder's files; of recorded traces those that are there.

    Raises:
        ConfigError: names file and key.
    """
    files = (
        validate(ScenarioFile, parse_yaml(read_text(path), str(path)), str(path))
        for path in sorted(folder.glob("*.yaml"))
    )
    return [scenario for file in files for scenario in _expand(file, traces)]


def _expand(file: ScenarioFile, traces: Sequence[TraceEntry]) -> Iterator[Scenario]:
    common = Scenario("", file.case, file.about, file.duration_s, file.traffic)
    network = file.network
    if network.generator is not None:
        for seed in network.seeds:
            yield replace(common, name=f"{file.name}-{seed}", kind=network.generator, seed=seed)
    elif network.traces is not None:
        for window in choose(traces, network.traces, network.of_each_family, file.duration_s):
            yield replace(common, name=f"{file.name}-{window.name}", window=window)
