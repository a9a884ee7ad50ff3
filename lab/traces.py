"""Turns recorded paths into steps of the lab's links; `plr.controlplane.planning.traces` defines the file format."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lab.errors import LabConfigError
from lab.profile import LinkProfile
from plr.controlplane.planning import traces

if TYPE_CHECKING:
    from plr.controlplane.planning.traces import Direction, RecordedPaths


@dataclass(frozen=True, slots=True)
class TraceStep:
    """The state of the link from `at_s` on, in seconds from the trace's start."""

    at_s: float
    up: LinkProfile
    down: LinkProfile

    def to_json(self) -> list[Any]:
        """Return [at_s, up, down], ready for JSON."""
        return [self.at_s, self.up.to_json(), self.down.to_json()]

    @classmethod
    def from_json(cls, fields: list[Any]) -> TraceStep:
        """Return the step that `to_json` encoded.

        Raises:
            LabConfigError: the fields are not such a list.
        """
        try:
            at_s, up, down = fields
            return cls(float(at_s), LinkProfile.from_json(up), LinkProfile.from_json(down))
        except (TypeError, ValueError) as error:
            raise LabConfigError(f"trace step: {error}") from None


@dataclass(frozen=True, slots=True)
class Trace:
    """The steps of each path, in order of time; all paths start at 0 and share one clock."""

    name: str
    paths: dict[str, tuple[TraceStep, ...]]

    @property
    def duration_s(self) -> float:
        """Start of the last step, plus the length of the step before it."""
        times = [step.at_s for step in next(iter(self.paths.values()))]
        return times[-1] + (times[-1] - times[-2] if len(times) > 1 else 1.0)

    def path(self, name: str) -> tuple[TraceStep, ...]:
        """Return the steps of one path.

        Raises:
            LabConfigError: no such path.
        """
        try:
            return self.paths[name]
        except KeyError:
            raise LabConfigError(f"trace {self.name}: no path {name!r}, only {sorted(self.paths)}") from None


def load_trace(file: str | Path, *, queue_bytes: int = traces.DEFAULT_QUEUE_BYTES) -> Trace:
    """Read a trace file; both paths get a bottleneck queue of `queue_bytes`.

    Raises:
        LabConfigError: the file is unreadable, or not in the format; the text names file and line.
    """
    try:
        return _as_links(traces.read_trace(Path(file), queue_bytes=queue_bytes))
    except traces.TraceError as error:
        raise LabConfigError(str(error)) from None


def parse_trace(text: str, *, name: str = "trace", queue_bytes: int = traces.DEFAULT_QUEUE_BYTES) -> Trace:
    """Parse the text of a trace file.

    Raises:
        LabConfigError: the text is not in the format; the error names the line.
    """
    try:
        return _as_links(traces.parse_trace(text, name=name, queue_bytes=queue_bytes))
    except traces.TraceError as error:
        raise LabConfigError(str(error)) from None


def _as_links(recorded: RecordedPaths) -> Trace:
    paths = {
        path: tuple(TraceStep(step.at_s, _profile(step.up), _profile(step.down)) for step in steps)
        for path, steps in recorded.paths.items()
    }
    return Trace(recorded.name, paths)


def _profile(direction: Direction) -> LinkProfile:
    return LinkProfile(
        delay_ms=direction.delay_ms,
        loss=direction.loss,
        rate_kbps=direction.rate_kbps,
        queue_bytes=direction.queue_bytes,
    )
