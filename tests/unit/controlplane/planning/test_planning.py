"""Planning: replayed paths, recorded services, the least set, and the command around them."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from google.protobuf import json_format

from plr.controlplane.cli.__main__ import main
from plr.controlplane.planning.prospects import Prospect, least_set, paths_needed
from plr.controlplane.planning.recorded import RecordedService
from plr.controlplane.planning.replay import ReplayedTraces, replay
from plr.controlplane.planning.traces import COLUMNS, RecordedPaths, parse_trace
from plr.controlplane.planning.workload import Compute, Workload
from plr.protos.base.histogram import Histogram
from plr.protos.convert import explanation_to_proto
from plr.protos.model.explanation import SAMPLE, Belief, Correlation, Explanation, JointExplanation, PairExplanation
from plr.protos.model.ids import InterfaceName, NodeName, ServiceName
from plr.protos.model.mapping import Assignment
from plr.protos.model.status import ResourceStatus
from tests.support.samples import histogram

if TYPE_CHECKING:
    from pathlib import Path

WORKLOAD = Workload(request_bytes=1000, answer_bytes=100, rate_hz=20.0, compute=Compute(0.01, 0.02))


def trace_text(*, dark_a: set[int], dark_b: set[int]) -> str:
    """A row a second: 10 Mbit/s over 20 ms each, but in the dark."""
    lines = [",".join(COLUMNS)]
    for second in range(60):
        a, b = (0 if second in dark else 10_000 for dark in (dark_a, dark_b))
        lines.append(f"{second},{a},{a},20,0,{b},{b},20,0")
    return "\n".join(lines) + "\n"


def trace(dark_a: set[int], dark_b: set[int]) -> RecordedPaths:
    return parse_trace(trace_text(dark_a=dark_a, dark_b=dark_b), name="test")


def test_one_server_answers_over_either_path_what_it_ran_once() -> None:
    found = replay(trace(set(), {5}), WORKLOAD)
    alone = np.array(found.alone)
    assert np.all(found.two_servers == alone.min(axis=0))
    # 20 ms of propagation, what the server takes, and some for the bytes.
    assert np.median(found.one_server) == pytest.approx(0.031, abs=0.002)
    # With two servers the faster computing of two counts, with one there is no choice.
    assert np.median(found.two_servers) < np.median(found.one_server)


def test_what_fails_together_is_told_from_what_does_not() -> None:
    together = ReplayedTraces([trace({5, 20}, {5, 20})], WORKLOAD).prospects(0.2)
    apart = ReplayedTraces([trace({5, 20}, {10, 30})], WORKLOAD).prospects(0.2)
    for sets in (together, apart):
        assert [(found.interfaces, found.servers) for found in sets] == [(1, 1), (2, 1), (2, 2)]
        assert sets[0].joint == pytest.approx(2 / 60, rel=0.3)
        assert sets[2].product == pytest.approx(sets[0].joint ** 2, rel=0.3)
    assert together[2].joint == pytest.approx(2 / 60, rel=0.3)
    assert apart[2].joint < 1e-3
    assert apart[2].joint > 0.0


@pytest.mark.parametrize(
    ("epsilon", "target", "paths"),
    [(0.1, 0.001, 3), (0.1, 0.0009, 4), (0.5, 0.5, 1), (0.01, 0.5, 1), (0.9, 1e-9, 197), (1.0, 0.5, None)],
)
def test_enough_independent_paths_meet_any_target(epsilon: float, target: float, paths: int | None) -> None:
    assert paths_needed(epsilon, target) == paths
    if paths is not None and paths > 1:
        assert epsilon**paths <= target * (1 + 1e-9) < epsilon ** (paths - 1)


def test_the_least_set_has_the_fewest_interfaces_then_servers() -> None:
    sets = [Prospect(1, 1, "", 0.1, 0.1), Prospect(2, 1, "", 0.01, 0.02), Prospect(2, 2, "", 0.01, 0.015)]
    assert least_set(sets, 0.1) is sets[0]
    assert least_set(sets, 0.05) is sets[1]
    assert least_set(sets, 0.016) is sets[2]
    assert least_set(sets, 0.01) is None


def scaled(*seconds: float, times: int, lost: int = 0) -> Histogram:
    return histogram(*seconds, times=times * SAMPLE, lost=lost * SAMPLE)


def on(interface: str, server: str) -> Assignment:
    return Assignment(InterfaceName(interface), NodeName(server))


def explanation(*, idempotent: bool = True) -> Explanation:
    """Two interfaces, which fail together, to two servers; a third server was only probed."""
    epsilon = {on("wlan0", "a"): 0.1, on("wlan0", "b"): 0.2, on("wwan0", "a"): 0.2, on("wwan0", "b"): 0.1}
    pairs = [
        PairExplanation(
            path,
            chosen=False,
            up=True,
            miss=Belief(mean, mean / 2, mean * 2),
            requests=100.0,
            probes=50.0,
            rtt=scaled(0.02, times=5),
            network=scaled(*[0.03] * 9, 0.3, times=1),
            compute=scaled(0.01, times=5),
        )
        for path, mean in epsilon.items()
    ]
    probed = PairExplanation(
        on("wwan0", "c"), False, None, None, 0.0, 50.0, scaled(0.05, times=5), Histogram(), Histogram()
    )
    joint = JointExplanation(
        InterfaceName("wlan0"), InterfaceName("wwan0"), None, 100.0, 10.0, 10.0, 8.0, Correlation.TOGETHER
    )
    return Explanation(
        NodeName("robot"),
        ServiceName("/plan"),
        0.1,
        idempotent,
        "joint",
        ResourceStatus(),
        pairs=(*pairs, probed),
        joints=(joint,),
    )


def test_of_recorded_pairs_the_best_set_of_each_size_is_found() -> None:
    sets = {(found.interfaces, found.servers): found for found in RecordedService(explanation()).prospects(0.1)}
    assert sets.keys() == {(1, 1), (2, 1), (2, 2)}
    # By its probes, none of which was slow.
    assert sets[1, 1].joint == pytest.approx(0.5 / 51)
    assert sets[1, 1].paths == "wwan0 -> c"
    assert sets[2, 1].joint == pytest.approx(0.1 * 0.2)
    assert sets[2, 2].joint == pytest.approx(8 * 0.1 * sets[1, 1].joint)


def test_a_measured_lift_counts() -> None:
    found = explanation()
    without_c = Explanation(
        found.robot, found.service, 0.1, True, "joint", found.sync, pairs=found.pairs[:4], joints=found.joints
    )
    best = RecordedService(without_c).prospects(0.1)[-1]
    assert best.paths == "wlan0 -> a, wwan0 -> b"
    assert best.product == pytest.approx(0.01)
    assert best.joint == pytest.approx(0.08)


def test_a_lift_of_other_times_makes_no_pair_miss_more_often_than_its_better_path() -> None:
    found = explanation()
    joints = tuple(replace(joint, first_missed=5.0, second_missed=5.0) for joint in found.joints)
    best = RecordedService(replace(found, pairs=found.pairs[:4], joints=joints)).prospects(0.1)[-1]
    assert best.joint == pytest.approx(0.1)


def test_one_slow_server_spoils_both_interfaces() -> None:
    found = explanation()
    pairs = tuple(
        replace(pair, miss=None, network=scaled(0.02, times=100), compute=scaled(*[0.01] * 9, 0.3, times=10))
        for pair in found.pairs[:4]
    )
    sets = RecordedService(replace(found, pairs=pairs, joints=())).prospects(0.1)
    assert [(found.interfaces, found.servers) for found in sets] == [(1, 1), (2, 1), (2, 2)]
    assert [found.product for found in sets] == pytest.approx([0.1, 0.01, 0.01], rel=0.1)
    assert [found.joint for found in sets] == pytest.approx([0.1, 0.1, 0.01], rel=0.1)


def test_at_another_deadline_the_recorded_latencies_decide() -> None:
    recorded = RecordedService(explanation())
    late, early = (recorded.prospects(deadline_s)[0].joint for deadline_s in (0.5, 0.01))
    assert late < 0.05
    assert early > 0.9


def test_what_must_run_once_goes_to_one_server() -> None:
    sets = RecordedService(explanation(idempotent=False)).prospects(0.1)
    assert [(found.interfaces, found.servers) for found in sets] == [(1, 1), (2, 1)]


# ── the command ──


def plan(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str]:
    try:
        code = main(["plan", *arguments])
    except SystemExit as end:
        code = int(end.code or 0)
    out, err = capsys.readouterr()
    return code, out + err


@pytest.fixture
def traces(tmp_path: Path) -> Path:
    (tmp_path / "one.csv").write_text(trace_text(dark_a={5, 20}, dark_b={10, 20}))
    return tmp_path


def test_it_names_the_least_set_or_what_is_missing(traces: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = ("--traces", str(traces), "--deadline-ms", "200")
    code, text = plan(capsys, *given, "--target", "0.03")
    assert code == 0
    assert "least set for 0.03: 2 interfaces and" in text
    code, text = plan(capsys, *given, "--target", "1e-6")
    assert code == 1
    assert "no set meets 1e-06" in text
    assert "would do if they failed independently" in text
    assert "record more" in text
    code, text = plan(capsys, *given, "--json")
    assert code == 0
    assert [found["interfaces"] for found in json.loads(text)["sets"]] == [1, 2, 2]


def test_it_draws(traces: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = traces / "plan.html"
    code, _ = plan(capsys, "--traces", str(traces), "--deadline-ms", "200", "--plot", str(file))
    assert code == 0
    assert file.read_text().startswith("<!doctype html>")
    assert "</svg>" in file.read_text()
    code, text = plan(capsys, "--traces", str(traces), "--deadline-ms", "200", "--plot", str(traces / "plan.wav"))
    assert (code, text.count("\n")) == (2, 1)
    assert ".svg or .html" in text


def test_without_matplotlib_it_says_what_to_install(
    traces: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    code, text = plan(capsys, "--traces", str(traces), "--deadline-ms", "200", "--plot", str(traces / "plan.svg"))
    assert code == 2
    assert "pip install matplotlib" in text


def test_it_reads_what_explain_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "robot.json"
    message = explanation_to_proto(explanation())
    file.write_text(json_format.MessageToJson(message, preserving_proto_field_name=True))
    code, text = plan(capsys, "--recorded", str(file), "--target", "0.008")
    assert code == 0
    assert "robot /plan: 5 pairs with evidence" in text
    assert "to miss 100 ms" in text
    assert math.isclose(json.loads(plan(capsys, "--recorded", str(file), "--json")[1])["deadline_ms"], 100.0)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("--traces", "DIR"), "--traces needs --deadline-ms"),
        (("--traces", "DIR/empty", "--deadline-ms", "9"), "no .csv or .csv.gz"),
        (("--traces", "DIR/none.csv", "--deadline-ms", "9"), "No such file"),
        (("--traces", "DIR", "--deadline-ms", "9", "--rate-hz", "1e9"), "give fewer traces"),
        (("--traces", "DIR", "--deadline-ms", "9", "--rate-hz", "0.001"), "too short"),
        (("--traces", "DIR", "--deadline-ms", "9", "--compute-ms", "20"), "expected MEDIAN:P99"),
        (("--traces", "DIR", "--deadline-ms", "9", "--compute-ms", "20:nan"), "expected MEDIAN:P99"),
        (("--traces", "DIR", "--deadline-ms", "nan"), "expected a number above 0"),
        (("--traces", "DIR", "--deadline-ms", "9", "--target", "1"), "below 1"),
        (("--traces", "DIR", "--deadline-ms", "9", "--request-bytes", "0"), "from 1 to 16777216, got '0'"),
        (("--recorded", "DIR/one.csv"), "not an answer of plr explain --json"),
        (("--recorded", "DIR/none.json"), "none.json"),
        (("--recorded", "DIR/one.csv", "--rate-hz", "5"), "need --traces"),
    ],
)
def test_what_makes_no_sense_is_refused(
    traces: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], told: str
) -> None:
    (traces / "empty").mkdir()
    code, text = plan(capsys, *(argument.replace("DIR", str(traces)) for argument in arguments))
    assert code == 2
    assert told in text
