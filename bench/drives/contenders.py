"""Names what runs over a window, and runs it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from bench.drives.oracles import Causal, causal
from bench.drives.simulation import drive
from bench.evaluation import ideal, oracle
from plr.protos.model.redundancy_mode import RedundancyMode

if TYPE_CHECKING:
    from bench.evaluation.outcome import Outcome
    from bench.evaluation.scenario import Scenario

FIFO = "ideal"
CLAIRVOYANT = ideal.ORACLE
FIFO_ALONE = {path: f"{FIFO}-{path}" for path in ("a", "b")}
"""One first-in-first-out path."""
COMPUTED = (FIFO, *(kind.value for kind in Causal), CLAIRVOYANT)
"""Oracles: nothing of ours runs."""
MODES = {f"plr-{mode.value}": mode for mode in RedundancyMode}
ALONE = {f"{name}-{path}": (mode, path) for name, mode in MODES.items() for path in FIFO_ALONE}
"""One mode on one path alone."""
CONTENDERS = (*COMPUTED, *FIFO_ALONE.values(), *MODES, *ALONE)


def run(scenario: Scenario, contender: str) -> Outcome:
    """Return what this contender achieves; KeyError if there is none of this name."""
    if contender in ideal.IDEALS:
        return ideal.compute(scenario, contender)
    if contender == CLAIRVOYANT:
        return oracle.compute(scenario)
    if contender in {kind.value for kind in Causal}:
        return causal(scenario, Causal(contender))
    if contender in ALONE:
        mode, path = ALONE[contender]
        return drive(scenario, mode, (path,)).outcome
    return drive(scenario, MODES[contender]).outcome
