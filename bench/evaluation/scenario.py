"""Reads scenarios from the YAML files of a folder: what is requested over which two paths.

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
from plr.protos.program.config_file import parse_yaml, read_text, validate

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from lab import Trace
    from lab.trace_folder import TraceEntry

FOLDER = Path(__file__).with_name("scenarios")
HEADER_BYTES = 16
"""Size of the smallest request and answer, which a contender needs to tell one from another."""


def _known_kind(name: str) -> str:
    if name not in KINDS:
        raise ValueError(f"expected one of {', '.join(KINDS)}")
    return name


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Traffic(_Section):
    """The requests of a scenario."""

    request_bytes: Annotated[int, Field(ge=HEADER_BYTES, le=10_000_000)]
    answer_bytes: Annotated[int, Field(ge=HEADER_BYTES, le=10_000_000)]
    rate_hz: Annotated[float, Field(gt=0, le=1000)]
    deadline_ms: Annotated[float, Field(gt=0, le=10_000)]
    compute_ms: Annotated[float, Field(ge=0, le=10_000)]
    """Time that a server takes for each request, one at a time."""
    stall_ms: Annotated[float, Field(ge=0, le=60_000)] = 0.0
    """Extra time that the first server (that of carrier a if each has its own) takes at times ..."""
    stall_every: Annotated[int, Field(ge=0)] = 0
    """... namely for one in this many requests; 0 means never."""

    def compute(self, *, first: bool) -> dict[str, Any]:
        """Return the arguments of `bench.dataplane.calling.Compute` for the first or any other server."""
        stall_s, every = (self.stall_ms / 1e3, self.stall_every) if first else (0.0, 0)
        return {"compute_s": self.compute_ms / 1e3, "stall_s": stall_s, "stall_every": every}


class _Network(_Section):
    generator: Annotated[str, AfterValidator(_known_kind)] | None = None
    seeds: Annotated[tuple[int, ...], Field(min_length=1)] = (1,)
    traces: str | None = None
    """Glob pattern of trace names."""
    of_each_family: Annotated[int, Field(ge=1)] = 1

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if (self.generator is None) == (self.traces is None):
            raise ValueError("expected either generator or traces")
        return self


class ScenarioFile(_Section):
    """The content of a scenario file."""

    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9-]{0,40}$")]
    case: Literal["A", "B", "C", "D", "E", "F", "G"]
    about: str
    duration_s: Annotated[float, Field(ge=5, le=3600)] = 120.0
    traffic: Traffic
    network: _Network


@dataclass(frozen=True, slots=True)
class Scenario:
    """A window of a network, and the requests in it."""

    name: str
    case: str
    about: str
    duration_s: float
    traffic: Traffic
    kind: str | None = None
    """Kind of the generator; None if recorded."""
    seed: int = 0
    window: Window | None = None
    """Window of a recorded trace."""

    @property
    def count(self) -> int:
        """Number of requests in the window; request k is due at k / rate_hz."""
        return int(self.duration_s * self.traffic.rate_hz)

    def trace(self) -> Trace:
        """Return the window's trace, whose clock starts with it; raises LabConfigError if it is not readable."""
        if self.window is not None:
            return self.window.load()
        assert self.kind is not None
        return generate(self.kind, self.seed, self.duration_s)

    def shortened(self, duration_s: float) -> Scenario:
        """Return at most this length of it, renamed if shorter: generated shorter, or the middle of a recording."""
        if duration_s >= self.duration_s:
            return self
        window = None if self.window is None else self.window.middle(duration_s)
        return replace(self, name=f"{self.name}-{duration_s:g}s", duration_s=duration_s, window=window)


def read_scenarios(traces: Sequence[TraceEntry], folder: Path = FOLDER) -> list[Scenario]:
    """Return all scenarios of a folder's files; of the recorded ones, those whose traces are present.

    Raises:
        ConfigError: a file is invalid; the text names file and key.
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
