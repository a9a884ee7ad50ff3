"""Groups windows that belong together, and pools contenders over the same ones.

Recorded windows of a case study are one study, generated windows of one scenario file another. Contenders are pooled
over the same windows: those in which both direct runs, ours and the ideal ran. A contender that did not run in most of
them is left out, and a window in which one of the others is missing, or void, does not count.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from bench.evaluation.comparison import DIRECT, IDEAL, SUREST
from bench.evaluation.contenders import CONTENDERS
from bench.evaluation.ideal import COMPUTED
from bench.evaluation.outcome import Outcome, by_window, together

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

CASES = {
    "A": "driving with two carriers",
    "B": "indoors with Wi-Fi and 5G",
    "C": "two Wi-Fi",
    "D": "Starlink and cellular",
    "E": "one carrier's blind spots, handovers, a server that stops",
    "F": "both carriers poor",
    "G": "two radios of one operator",
}
SHOWN = (*CONTENDERS, IDEAL)
"""Contenders in charts; the ideal of each path alone appears only in the tables."""
ANCHORS = (*DIRECT, SUREST, IDEAL)
"""Only windows in which these ran are pooled, as far as they ran at all."""
SHOWN_SHARE = 0.75
"""Other contenders that ran in less than this share of them are left out."""

_NAME = re.compile(r"(?P<stem>.+?)(?P<recorded>-at-[\d.]+)?(?P<shortened>-[\d.]+s)?")


def is_recorded(scenario: str) -> bool:
    """Return whether a scenario of this name replays a whole window of a recorded trace."""
    return bool((match := _NAME.fullmatch(scenario)) and match["recorded"] and not match["shortened"])


@dataclass(frozen=True, slots=True)
class Pool:
    """Contenders in the same windows."""

    runs: dict[str, tuple[Outcome, ...]]
    """Contender -> its run in each of `windows`."""
    windows: tuple[str, ...]
    left_out: dict[str, int]
    """Contender -> number of windows in which it ran, which are too few."""

    def together(self, contender: str) -> Outcome:
        """Return all requests of a contender as one run."""
        return together(self.runs[contender])


@dataclass(frozen=True, slots=True)
class Study:
    """Windows that belong together."""

    name: str
    """Name for files."""
    title: str
    case: str
    recorded: bool
    windows: dict[str, dict[str, Outcome]]
    """Scenario -> contender -> run; none is void."""

    def hardest(self, contenders: Sequence[str]) -> str | None:
        """Return the window with most misses of both direct runs, among those where all these ran; None without any."""
        able = [name for name, runs in self.windows.items() if {*contenders, *DIRECT} <= runs.keys()]
        return max(able, key=lambda name: sum(self.windows[name][one].figures().misses for one in DIRECT), default=None)


def studies(outcomes: Iterable[Outcome]) -> list[Study]:
    """Return the studies in order of case, recorded ones first."""
    found: dict[_Key, dict[str, dict[str, Outcome]]] = {}
    for scenario, runs in by_window(outcomes).items():
        found.setdefault(_key(scenario, next(iter(runs.values())).case), {})[scenario] = runs
    return [
        Study(key.study, f"Case {key.case}, {CASES[key.case]}: {key.stem}", key.case, not key.made_up, found[key])
        for key in sorted(found)
    ]


def study_of(scenario: str, case: str) -> str:
    """Return the name of the study that a scenario of this case belongs to."""
    return _key(scenario, case).study


class _Key(NamedTuple):
    case: str
    made_up: bool
    stem: str

    @property
    def study(self) -> str:
        return f"{self.case.lower()}-{self.stem}"


def _key(scenario: str, case: str) -> _Key:
    match = _NAME.fullmatch(scenario)
    assert match is not None
    stem = "recorded" if match["recorded"] else match["stem"].rstrip("0123456789").rstrip("-")
    return _Key(case, not match["recorded"], stem + (match["shortened"] or ""))


def pool(
    windows: Mapping[str, Mapping[str, Outcome]], names: Sequence[str] = SHOWN, anchors: Iterable[str] = ANCHORS
) -> Pool | None:
    """Pool what the contenders among `names` did in the same windows; return None if none ran."""
    needed = {name for name in anchors if any(name in runs for runs in windows.values())}
    windows = {window: runs for window, runs in windows.items() if runs.keys() >= needed} or windows
    ran = Counter(name for runs in windows.values() for name in runs if name in names)
    most = max(ran.values(), default=0)
    shown = [name for name in names if ran[name] and ran[name] >= SHOWN_SHARE * most]
    while shown:
        shared = tuple(window for window, runs in windows.items() if runs.keys() >= set(shown))
        if shared:
            left_out = {name: ran[name] for name in names if ran[name] and name not in shown}
            runs = {name: tuple(windows[window][name] for window in shared) for name in shown}
            return Pool(runs, shared, left_out)
        shown.remove(min(shown, key=lambda name: ran[name]))
    return None


def ranked(names: Iterable[str]) -> list[str]:
    """Return contenders in the order of tables and charts."""
    order = (*CONTENDERS, *COMPUTED)
    return sorted(names, key=lambda name: order.index(name) if name in order else len(order))
