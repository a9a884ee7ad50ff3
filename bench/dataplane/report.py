"""Collects the findings of one run for the JSON file and the page."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

from bench.dataplane.targets import TARGETS
from bench.reporting.tables import text_of

if TYPE_CHECKING:
    from bench.dataplane.section import Findings, Section
    from bench.dataplane.statistics import Interval
    from bench.reporting.tables import Figure


@dataclass(slots=True)
class Report:
    """The findings of one run."""

    machine: dict[str, Any]
    quick: bool
    repeats: int
    figures: dict[str, Figure] = field(default_factory=dict)
    intervals: dict[str, Interval] = field(default_factory=dict)
    sections: dict[str, Findings] = field(default_factory=dict)
    titles: dict[str, str] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)

    def add(self, section: Section, findings: Findings, seconds: float) -> None:
        """Add the findings of a section."""
        self.figures.update(findings.figures)
        self.intervals.update((key, found) for key, found in findings.intervals.items() if found is not None)
        self.sections[section.name] = findings
        self.titles[section.name] = section.title
        self.seconds[section.name] = round(seconds, 1)

    def ranges(self) -> dict[str, str]:
        """Return the intervals as text, by the figure's name."""
        return {
            key: f"{text_of(found.low)} to {text_of(found.high)}, {found.samples} samples"
            for key, found in self.intervals.items()
        }

    def as_json(self) -> dict[str, Any]:
        """Return the figures by name at the top, and their basis below."""
        return {
            **{target.key: None for target in TARGETS},
            **self.figures,
            "verdicts": {target.key: target.met(self.figures) for target in TARGETS},
            "intervals": {key: found._asdict() for key, found in self.intervals.items()},
            "machine": self.machine,
            "quick": self.quick,
            "repeats": self.repeats,
            "seconds": self.seconds,
            "sections": {name: asdict(findings) for name, findings in self.sections.items()},
        }
