from __future__ import annotations

from typing import TYPE_CHECKING

from bench.drives.targets import TARGETS, figures
from bench.evaluation.outcome import Outcome, Request

if TYPE_CHECKING:
    from collections.abc import Sequence


def outcome(contender: str, latencies_s: Sequence[float | None], sent: int = 0) -> Outcome:
    requests = tuple(
        Request(float(at), float(at), None if latency is None else at + latency)
        for at, latency in enumerate(latencies_s)
    )
    return Outcome("w", "A", contender, 1000.0, requests, {"a": sent} if sent else {})


def test_misses_are_compared_over_the_windows_that_both_ran() -> None:
    runs = {
        "one": {"ours": outcome("ours", [2.0, 0.1]), "causal-shared": outcome("causal-shared", [2.0, 2.0])},
        "two": {"ours": outcome("ours", [None, 2.0])},
    }
    before = {"two": outcome("before", [None, None, None, None]).figures()}
    found = figures(runs, "ours", before)
    assert found == {"misses_over_causal_shared": 0.5, "misses_over_replicate_before": 0.5}


def test_half_of_replicates_misses_is_asked_for_where_an_oracle_has_it() -> None:
    def window(oracle_misses: int) -> dict[str, Outcome]:
        oracle = outcome("causal-repair", [2.0] * oracle_misses)
        return {"ours": outcome("ours", [2.0]), "causal-repair": oracle}

    before = dict.fromkeys(("hard", "easy"), outcome("before", [None] * 4).figures())
    found = figures({"hard": window(3), "easy": window(2)}, "ours", before)
    assert found["misses_over_replicate_before"] == 2 / 8
    assert found["misses_over_replicate_where_attainable"] == 1 / 4


def test_the_worst_clean_window_counts() -> None:
    fast, slow = [0.1] * 4, [0.2] * 4
    runs = {
        "clean": {
            "ours": outcome("ours", slow, sent=500),
            "ideal": outcome("ideal", fast),
            "plr-single": outcome("plr-single", slow, sent=400),
        },
        "cleaner": {
            "ours": outcome("ours", fast, sent=400),
            "ideal": outcome("ideal", slow),
            "plr-single": outcome("plr-single", slow, sent=400),
        },
        "bad": {"ours": outcome("ours", [None] * 4), "ideal": outcome("ideal", [2.0] * 4)},
    }
    found = figures(runs, "ours", {})
    assert round(found["clean_mean_over_fifo_ms"]) == 100
    assert round(found["good_p99_over_fifo_ms"]) == 100
    assert found["clean_bytes_over_single"] == 900 / 800


def test_each_path_alone_is_compared_with_a_fifo_one() -> None:
    def window(ours: list[float | None], fifo: list[float | None]) -> dict[str, Outcome]:
        return {"ours-a": outcome("ours-a", ours), "ideal-a": outcome("ideal-a", fifo), "ideal-b": outcome("x", [9.0])}

    runs = {"good": window([0.11] * 4, [0.1] * 4), "bad": window([2.0, 2.0, 0.2, 0.2], [2.0, 0.2, 0.2, 0.2])}
    found = figures(runs, "ours", {})
    assert found["alone_misses_over_fifo"] == 0.25
    assert round(found["alone_p99_over_fifo"], 3) == 1.1
    assert round(found["alone_good_p99_over_fifo"], 3) == 1.1


def test_every_figure_has_a_target() -> None:
    assert len({target.key for target in TARGETS}) == len(TARGETS)
