"""Reads what an evaluation measured, window by window, from the records of its runs or its published figures."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Self

from bench.evaluation.outcome import Figures, Outcome, figures_by_window

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

_EXAMPLE = "docs/develop/results/evaluation.json"
_FIGURES = tuple(one.name for one in fields(Figures))


@dataclass(frozen=True, slots=True)
class Measured:
    """The figures of an evaluation, without void runs."""

    windows: dict[str, dict[str, Figures]]
    """Scenario -> contender -> figures."""
    cases: dict[str, str]
    """Scenario -> case study."""

    @classmethod
    def of(cls, outcomes: Iterable[Outcome]) -> Self:
        """Make it from the records of runs."""
        kept = list(outcomes)
        return cls(figures_by_window(kept), {one.scenario: one.case for one in kept})

    @classmethod
    def published(cls, file: Path) -> Self:
        """Read the `evaluation.json` of a report; raises ValueError, which names the file, if it is not one."""
        try:
            runs: Mapping[str, Mapping[str, Mapping[str, Any]]] = json.loads(file.read_text(encoding="utf-8"))["runs"]
            windows = {
                scenario: {
                    name: Figures(**{figure: one[figure] for figure in _FIGURES})
                    for name, one in by_name.items()
                    if not one["void"]
                }
                for scenario, by_name in runs.items()
            }
            return cls(windows, {scenario: one["case"] for scenario, by in runs.items() for one in by.values()})
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{file}: expected the data of a report, as {_EXAMPLE}: {error!r}") from None
