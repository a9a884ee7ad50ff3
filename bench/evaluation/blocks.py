"""Makes the blocks of an evaluation in README and docs: Markdown from `evaluation.json` alone, by block name."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from bench.evaluation import repeats
from bench.evaluation.alternatives import BETTER_DIRECT, OTHERS
from bench.evaluation.comparison import DIRECT, IDEAL, SUREST
from bench.evaluation.ideal import ORACLE
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
    "oracle": "`oracle`: knows the trace, splits each request between both paths",
    "ideal": "`ideal` (computed, not a bound): each request goes over two FIFO queues, the faster answer counts",
}
_NOTHING: Content = {}


def all_blocks(content: Content) -> dict[str, str]:
    """Return name -> Markdown; for empty content, all blocks say that nothing was measured."""
    return {name: make(content).strip() for name, make in _BLOCKS.items()}


def _drives(content: Content) -> str:
    found = content.get("everywhere")
    return _same_drives(content, found[0]) if found else NOTHING


def _modes_drives(content: Content) -> str:
    found = content.get("everywhere")
    if not found:
        return NOTHING
    return _same_drives(content, found[1]) if len(found) > 1 else "Every mode ran in every window, or none did."


def _same_drives(content: Content, one: Mapping[str, Any]) -> str:
    found: Mapping[str, Mapping[str, Any]] = one["contenders"]
    windows, hard = one["windows"], one["hard_windows"]
    requests = next(iter(found.values()))["requests"]
    if windows == content["everywhere"][0]["windows"]:
        about = (
            f"Every row covers all {len(windows)} windows of recorded drives, {requests} requests together. "
            f"{_distinct(content)}"
        )
    else:
        about = f"Every mode ran in {len(windows)} windows. In {hard} of them, a direct run misses a request."
    shares = ("missed", "missed, each drive with equal weight", "never answered")
    columns = ("", *shares, "mean", "P50", "P99", "P99, median of the windows", "kB a request")
    rows = tuple(
        (
            _label(name),
            _percent(figures["miss_ratio"]),
            "-" if figures["distinct_miss_ratio"] is None else _percent(figures["distinct_miss_ratio"]),
            _percent(figures["unanswered_ratio"]),
            *(_time(figures[key]) for key in ("mean_ms", "p50_ms", "p99_ms", "median_p99_ms")),
            _kilobytes(figures),
        )
        for name, figures in found.items()
        if name != ORACLE
    )
    gains = [
        NOT_MEASURED if one[key] is None else f"{_number(one[key])} times lower"
        for key in ("median_mean_gain", "median_p99_gain")
    ]
    return (
        f"{about} {_UNANSWERED}\n\n{table_as_markdown(Table('', columns, rows))}"
        f"\nCompared with the better direct run of the same window, `{SUREST}`'s mean is {gains[0]}, and its "
        f"P99 is {gains[1]} (medians of the {len(windows)} windows).{_beside_oracle(found)}"
    )


def _beside_oracle(found: Mapping[str, Mapping[str, Any]]) -> str:
    if ORACLE not in found:
        return ""
    ours, least = (found[name]["miss_ratio"] for name in (SUREST, ORACLE))
    times = f" This is {least / ours * 100:.0f} % of what `{SUREST}` misses." if ours else ""
    return (
        "\n`oracle` is computed, too. It knows what each path will carry, and splits every request between both paths. "
        f"It misses {_percent(least)}.{times}"
    )


def _oracle(content: Content) -> str:
    everywhere = content.get("everywhere")
    if not everywhere or ORACLE not in everywhere[0]["contenders"]:
        return NOTHING
    found = everywhere[0]["contenders"]
    rows = tuple(
        (_label(name), round(found[name]["miss_ratio"] * found[name]["requests"]), _percent(found[name]["miss_ratio"]))
        for name in (IDEAL, SUREST, ORACLE)
    )
    columns = (f"all {len(everywhere[0]['windows'])} recorded drives", f"missed of {found[SUREST]['requests']}", "")
    return table_as_markdown(Table("", columns, rows))


def _distinct_drives(content: Content) -> str:
    drives = content.get("drives")
    if drives is None:
        return "Not looked at: `python -m bench report --traces FOLDER`."
    rows = tuple(
        (number, ", ".join(f"`{name}`" for name in names)) for number, names in enumerate(drives["distinct"], 1)
    )
    windows = sum(map(len, drives["distinct"]))
    about = f"{windows} windows, {len(rows)} drives, {drives['recordings']} recordings"
    return f"{about}:\n\n{table_as_markdown(Table('', ('drive', 'windows that share half or more of it'), rows))}"


def _distinct(content: Content) -> str:
    drives = content.get("drives")
    if drives is None:
        return "Which of them are one drive was not looked at."
    count, recordings = len(drives["distinct"]), drives["recordings"]
    return (
        f"Only {count} of the windows are distinct drives, from {recordings} recordings. The others replay seconds of "
        "these drives."
    )


def _cases(content: Content) -> str:
    studies = {name: one for name, one in content.get("studies", _NOTHING).items() if name != DRIVES and one["windows"]}
    if not studies:
        return NOTHING
    columns = ("", "windows", "", "missed", "never answered", "mean", "P50", "P99", "kB a request")
    rows = []
    for study, one in studies.items():
        case, _, stem = study.partition("-")
        shown = [name for name in one["contenders"] if name not in DIRECT]
        for number, name in enumerate(shown):
            about = (f"{case.upper()}: {CASES[case.upper()]}, {stem}", len(one["windows"])) if number == 0 else ("", "")
            rows.append((*about, _label(name), *_all_figures(one["contenders"][name])))
    return f"{_UNANSWERED} P99 is of all requests.\n\n{table_as_markdown(Table('', columns, tuple(rows)))}"


def _others(content: Content) -> str:
    found = content.get("others")
    if not found:
        return NOTHING
    columns = ("", "windows", "missed", "never answered", "mean", "P50", "P99", "kB a request")
    ours_label = f"`{SUREST}` in the same windows"
    rows: list[tuple[str | int, ...]] = []
    for name in (BETTER_DIRECT, *OTHERS):
        if name in found:
            one = found[name]
            theirs, ours = ((one["windows"], *_all_figures(one[who]["figures"])) for who in ("theirs", "ours"))
            rows = [row for row in rows if row != (ours_label, *ours)]
            rows += [(_label(name), *theirs), (ours_label, *ours)]
    told = {"miss_ratio": "missed", "unanswered_ratio": "never answered", "mean_ms": "mean", "p50_ms": "P50"}
    told |= {"p99_ms": "P99", "bytes_per_request": "bytes"}
    counts = tuple(
        (_label(name), *(f"{theirs} : {ours}" for theirs, ours in (found[name]["lower"][key] for key in told)))
        for name in (BETTER_DIRECT, *OTHERS)
        if name in found
    )
    return (
        f"{_UNANSWERED} P99 is of all requests.\n\n{table_as_markdown(Table('', columns, tuple(rows)))}"
        "\nThe next table counts windows. The number before each colon counts the windows in which the contender has "
        f"the lower figure. The number after it counts those in which `{SUREST}` has the lower figure. In all other "
        "windows the two are equal."
        f"\n\n{table_as_markdown(Table('', ('', *told.values()), counts))}"
    )


def _measured(content: Content) -> str:
    runs = content.get("runs")
    if not runs:
        return NOTHING
    measured, machine = content["measured"], dict(content.get("machine", _NOTHING))
    recorded = sum(map(len, runs.values()))
    void = sum(bool(run["void"]) for window in runs.values() for run in window.values())
    for key in ("measured_at", "commit"):
        machine.pop(key, None)
    on = "".join(f", {key}: {value}" for key, value in machine.items())
    commits = ", ".join(measured["commits"]) or "not recorded"
    files = "[Summary with charts](results/evaluation.md), [every figure](results/evaluation.json)"
    runs_of = f"{measured['runs']} runs in {len(runs)} windows were measured, {void} of them void"
    computed = f"{recorded - measured['runs']} more runs are computed from the traces"
    when = f"The measurement lasted from {measured['from']} to {measured['to']}"
    where = f"The newest run was made on this machine:{on.removeprefix(',')}"
    return f"{runs_of}. {computed}. {when}. {where}. Commit: {commits}. {files}."


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
    columns = ("`redundancy`", "windows", "missed", "avoided misses (`replicate` = 100 %)", "bytes beyond `single`")
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
    return (
        f"With `extra_load: 0.1`, the extra copies over one interface had at most {_percent(share)} of the bytes of "
        f"the requests that were answered in time ({content['from']['budget_extra_share']})."
    )


def _fallback(content: Content) -> str:
    late = content.get("fallback_late")
    if late is None:
        return NOTHING
    return f"Requests without an answer by the deadline: {late} {content['from']['fallback_late']}."


_BLOCKS: dict[str, Callable[[Content], str]] = {
    "drives": _drives,
    "modes-drives": _modes_drives,
    "oracle": _oracle,
    "distinct": _distinct_drives,
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
_UNANSWERED = f"A request without an answer after {UNANSWERED_S:g} s counts as {UNANSWERED_S:g} s."


def _label(name: str) -> str:
    return LIKE.get(name, f"`{name}`")


def _all_figures(one: Mapping[str, Any]) -> tuple[str, ...]:
    shares = (_percent(one[key]) for key in ("miss_ratio", "unanswered_ratio"))
    return (*shares, *(_time(one[key]) for key in ("mean_ms", "p50_ms", "p99_ms")), _kilobytes(one))


def _kilobytes(one: Mapping[str, Any]) -> str:
    sent = one["bytes_per_request"]
    return "computed" if sent is None else f"{sent / 1e3:.0f}"


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
