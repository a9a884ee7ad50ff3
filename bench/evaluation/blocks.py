"""What README and docs show of an evaluation: Markdown from `evaluation.json` alone, by the names of their blocks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from bench.evaluation import repeats
from bench.evaluation.comparison import DIRECT
from bench.evaluation.others import BETTER_DIRECT, OTHERS, PLR
from bench.evaluation.outcome import UNANSWERED_S
from bench.evaluation.repeats import Repeat, Repeats
from bench.evaluation.studies import CASES
from bench.evaluation.targets import TARGETS
from bench.reporting.tables import Table, table_as_markdown

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    Content = Mapping[str, Any]

NOT_MEASURED = "not measured"
NOTHING = "Not measured yet."
DRIVES = "a-recorded"
"""The study of recorded drives."""
LIKE = {
    BETTER_DIRECT: "ROS 2 over the better path of each window, chosen afterwards",
    "mptcp": "`mptcp`: the kernel's multipath TCP",
    "zenoh": "`zenoh` over both, first reply",
    "zenoh-drop": "`zenoh-drop`: the same, dropping what finds its queue full",
    "ideal": "`ideal`: the faster of two first-in-first-out paths for each request",
}
_NOTHING: Content = {}


def all_blocks(content: Content) -> dict[str, str]:
    """Name -> Markdown; of an empty content, all say that nothing was measured."""
    return {name: make(content).strip() for name, make in _BLOCKS.items()}


def _drives(content: Content) -> str:
    study = content.get("studies", _NOTHING).get(DRIVES, _NOTHING)
    if not study.get("windows"):
        return NOTHING
    names = (BETTER_DIRECT, *OTHERS, *PLR, "ideal")
    found = {name: study["contenders"][name] for name in names if name in study["contenders"]}
    columns = ("", "missed", "mean", "P99, median drive", "kB a request")
    rows = tuple((_label(name), *_figures(one, one["median_p99_ms"])) for name, one in found.items())
    drives, requests = len(study["windows"]), next(iter(found.values()))["requests"]
    text = f"{drives} drives, {requests} requests each. {_UNANSWERED}\n\n{table_as_markdown(Table('', columns, rows))}"
    gains = [_number(content.get(key)) for key in ("mean_gain", "p99_gain")]
    if NOT_MEASURED not in gains:
        counted = content["from"]["mean_gain"]
        text += (
            f"\nThe mean of `plr-replicate` is {gains[0]} times lower than that of the better direct run, its P99 "
            f"{gains[1]} times (medians of the {counted})."
        )
    return text


def _cases(content: Content) -> str:
    studies = {name: one for name, one in content.get("studies", _NOTHING).items() if name != DRIVES and one["windows"]}
    if not studies:
        return NOTHING
    columns = ("", "windows", "", "missed", "mean", "P99", "kB a request")
    rows = []
    for study, one in studies.items():
        case, _, stem = study.partition("-")
        shown = [name for name in one["contenders"] if name not in DIRECT]
        for number, name in enumerate(shown):
            about = (f"{case.upper()}: {CASES[case.upper()]}, {stem}", len(one["windows"])) if number == 0 else ("", "")
            rows.append((*about, _label(name), *_figures(one["contenders"][name])))
    return f"{_UNANSWERED} P99 is of all requests.\n\n{table_as_markdown(Table('', columns, tuple(rows)))}"


def _others(content: Content) -> str:
    found = content.get("others")
    if not found:
        return NOTHING
    columns = ("", "drives", "missed", "mean", "P99", "kB", "`plr-replicate`: missed", "mean", "P99", "kB")
    rows = []
    for name in (BETTER_DIRECT, *OTHERS):
        if name in found:
            one = found[name]
            both = (cell for who in ("theirs", "ours") for cell in _figures(one[who]["figures"]))
            rows.append((_label(name), one["windows"], *both))
    return f"{_UNANSWERED} P99 is of all requests.\n\n{table_as_markdown(Table('', columns, tuple(rows)))}"


def _measured(content: Content) -> str:
    runs = content.get("runs")
    if not runs:
        return NOTHING
    counted = sum(map(len, runs.values()))
    void = sum(bool(run["void"]) for window in runs.values() for run in window.values())
    on = "".join(f", {key.replace('_', ' ')}: {value}" for key, value in content.get("machine", _NOTHING).items())
    files = "[summary with charts](results/evaluation.md), [every figure](results/evaluation.json)"
    return f"{counted} runs in {len(runs)} windows, {void} of them void{on}: {files}."


def _verdicts(content: Content) -> str:
    notes = content.get("from", _NOTHING)
    rows = tuple(
        (f"`{one.key}`", _number(content.get(one.key)), one.wanted, one.verdict(content), notes.get(one.key, ""))
        for one in TARGETS
    )
    return table_as_markdown(Table("", ("figure", "value", "wanted", "verdict", "from"), rows))


def _paper(content: Content) -> str:
    found = content.get("paper")
    if not found:
        return NOTHING
    columns = (
        "times lower than over a single path",
        "paper: worse path, better path",
        "ours, mean of windows: worse, better",
        "windows",
        "ours, all requests: worse, better",
        "windows",
    )
    rows = tuple(
        (
            one["paper"]["about"] + ("" if one["recorded"] else " (made-up networks)"),
            _two(one["paper"]["over_worse"], one["paper"]["over_better"]),
            _two(one["over_worse"], one["over_better"]),
            one["hard_windows"],
            _two(one["pooled_over_worse"], one["pooled_over_better"]),
            one["windows"],
        )
        for one in found
    )
    return table_as_markdown(Table("", columns, rows))


def _reproduced(content: Content) -> str:
    found = content.get("reproduced")
    if not found:
        return NOTHING
    ratios = {name: Repeat(one["first"], one["second"]) for name, one in found["ratios"].items()}
    return table_as_markdown(repeats.table(Repeats(found["windows"], found["runs"], ratios)))


def _modes(content: Content) -> str:
    found = content.get("redundancy_modes")
    if not found:
        return NOTHING
    columns = ("`redundancy`", "windows", "missed", "of the misses that `replicate` avoids", "bytes beyond `single`")
    rows = tuple(
        (
            f"`{name.removeprefix('plr-')}`",
            one["windows"],
            _percent(one["miss_ratio"]),
            NOT_MEASURED if one["avoided"] is None else f"{one['avoided'] * 100:.0f} %",
            f"{one['extra_bytes'] * 100:.0f} %",
        )
        for name, one in found.items()
    )
    return table_as_markdown(Table("", columns, rows))


def _budgets(content: Content) -> str:
    share = content.get("budget_extra_share")
    if share is None:
        return NOTHING
    return f"Extra copies with `extra_load: 0.1`, at most: {_percent(share)} ({content['from']['budget_extra_share']})."


def _fallback(content: Content) -> str:
    late = content.get("fallback_late")
    if late is None:
        return NOTHING
    return f"Late with a fallback where both networks are poor: {late} {content['from']['fallback_late']}."


_BLOCKS: dict[str, Callable[[Content], str]] = {
    "drives": _drives,
    "others": _others,
    "measured": _measured,
    "verdicts": _verdicts,
    "cases": _cases,
    "paper": _paper,
    "reproduced": _reproduced,
    "modes": _modes,
    "budgets": _budgets,
    "fallback": _fallback,
}
_UNANSWERED = f"Who has no answer after {UNANSWERED_S:g} s counts as {UNANSWERED_S:g} s."


def _label(name: str) -> str:
    return LIKE.get(name, f"`{name}`")


def _figures(one: Mapping[str, Any], p99_ms: float | None = None) -> tuple[str, str, str, str]:
    sent = one["bytes_per_request"]
    tail_ms = one["p99_ms"] if p99_ms is None else p99_ms
    kilobytes = "computed" if sent is None else f"{sent / 1e3:.0f}"
    return _percent(one["miss_ratio"]), _time(one["mean_ms"]), _time(tail_ms), kilobytes


def _percent(share: float) -> str:
    return f"{share * 100:.1f} %"


def _time(milliseconds: float) -> str:
    if milliseconds >= UNANSWERED_S * 1e3:
        return "no answer"
    return f"{milliseconds:.0f} ms" if milliseconds < 999.5 else f"{milliseconds / 1e3:.1f} s"


def _number(value: float | None) -> str:
    if value is None:
        return NOT_MEASURED
    return f"{value:d}" if isinstance(value, int) else f"{value:.3g}"


def _two(worse: float | None, better: float | None) -> str:
    return ", ".join("-" if one is None else f"{one:.3g}" for one in (worse, better))
