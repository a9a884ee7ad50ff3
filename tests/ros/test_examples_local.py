"""The examples side by side, robot and server as separate processes, without any sidecar."""

from __future__ import annotations

import json
import signal
import time
from typing import TYPE_CHECKING, Any

import pytest

from tests.ros.processes import Program

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

pytestmark = pytest.mark.ros

MOTION = "examples.motion_planning"
HUMANS = "examples.human_detection"
POLL_S = 0.02


@pytest.fixture
def start(ros_domain: int, tmp_path: Path) -> Callable[..., Program]:
    """Starts `python -m MODULE OPTIONS` in a domain of this test's own."""

    def run(module: str, *options: str | Path) -> Program:
        return Program(module.rpartition(".")[2], ["-m", module, *options], ros_domain, tmp_path)

    return run


def records(path: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    content = json.loads(path.read_text())
    return content["summary"], content["requests"]


def wait_until(happened: Callable[[], bool], timeout_s: float = 30.0) -> None:
    end = time.monotonic() + timeout_s
    while not happened():
        assert time.monotonic() < end, "nothing happened"
        time.sleep(POLL_S)


def test_every_path_is_answered_once(start: Callable[..., Program], tmp_path: Path) -> None:
    journal, out = tmp_path / "journal", tmp_path / "run.json"
    with (
        start(f"{MOTION}.server", "--journal", journal) as server,
        start(f"{MOTION}.client", "--rate", "20", "--duration", "2", "--json", out) as robot,
    ):
        assert robot.wait() == 0, robot.output()
        assert server.interrupt() == 0, server.output()
    summary, requests = records(out)
    assert summary["sent"] == summary["answered_once"] == len(requests) == 40
    assert [request["index"] for request in requests] == list(range(40))
    assert all(request["answered"] and request["valid"] and request["latency_ms"] > 0 for request in requests)
    served = [json.loads(line) for line in journal.read_text().splitlines()]
    assert len({tuple(note["start"]) for note in served}) == len(served) == 40
    assert "Traceback" not in server.output() + robot.output()


def test_people_are_found_where_they_are(start: Callable[..., Program], tmp_path: Path) -> None:
    journal, out = tmp_path / "journal", tmp_path / "run.json"
    with (
        start(f"{HUMANS}.server", "--journal", journal) as server,
        start(f"{HUMANS}.client", "--rate", "5", "--duration", "3", "--json", out) as robot,
    ):
        assert robot.wait() == 0, robot.output()
        assert server.stop(signal.SIGTERM) == 0, server.output()
    summary, requests = records(out)
    assert summary["sent"] == summary["answered_once"] == 15
    found = sum(request["people_found"] for request in requests)
    assert found >= 0.6 * sum(request["people"] for request in requests)
    served = [json.loads(line) for line in journal.read_text().splitlines()]
    assert len({tuple(note["stamp"]) for note in served}) == len(served) == 15
    assert all(100_000 <= note["bytes"] <= 160_000 for note in served)


def test_a_late_answer_holds_up_no_later_request(start: Callable[..., Program], tmp_path: Path) -> None:
    out = tmp_path / "run.json"
    slow = ("--delay-ms", "1000", "--delay-every", "10")
    with (
        start(f"{MOTION}.server", *slow),
        start(f"{MOTION}.client", "--rate", "10", "--duration", "2", "--json", out) as robot,
    ):
        assert robot.wait() == 0, robot.output()
    _, requests = records(out)
    # The tenth and the twentieth are slow; the eleventh goes out while the tenth waits.
    tenth, eleventh = requests[9], requests[10]
    assert tenth["latency_ms"] >= 1000
    assert eleventh["sent_s"] < tenth["sent_s"] + tenth["latency_ms"] / 1e3


def test_a_second_answer_is_noticed(start: Callable[..., Program], ros_domain: int, tmp_path: Path) -> None:
    out = tmp_path / "run.json"
    with (
        Program("double_server", ["-m", "tests.ros.double_server"], ros_domain, tmp_path),
        start(f"{MOTION}.client", "--rate", "10", "--duration", "1", "--json", out) as robot,
    ):
        assert robot.wait() == 1, robot.output()
    summary, requests = records(out)
    # Only of the last request may the second answer come when nobody listens any more.
    assert summary["answered_twice"] >= summary["sent"] - 1
    assert all(request["answers"] == 2 for request in requests[:-1])


def test_a_wrong_answer_is_noticed(start: Callable[..., Program], tmp_path: Path) -> None:
    out = tmp_path / "run.json"
    with (
        start(f"{MOTION}.server", "--map-seed", "8"),
        start(f"{MOTION}.client", "--rate", "20", "--duration", "1", "--json", out) as robot,
    ):
        assert robot.wait() == 1, robot.output()
    summary, requests = records(out)
    assert summary["invalid"] > 0
    assert {"path through an obstacle"} <= {request["problem"] for request in requests}


def test_requests_to_a_dead_server_are_missing(start: Callable[..., Program], tmp_path: Path) -> None:
    journal, out = tmp_path / "journal", tmp_path / "run.json"
    with (
        start(f"{MOTION}.server", "--journal", journal) as server,
        start(f"{MOTION}.client", "--duration", "3", "--grace-s", "0.5", "--json", out) as robot,
    ):
        wait_until(lambda: journal.exists() and len(journal.read_text().splitlines()) >= 5)
        assert server.stop(signal.SIGKILL) == -signal.SIGKILL
        assert robot.wait() == 1, robot.output()
    summary, requests = records(out)
    assert summary["sent"] == 30
    assert summary["missing"] > 0
    assert summary["answered_once"] + summary["missing"] == 30
    assert not requests[-1]["answered"]
    assert requests[-1]["latency_ms"] is None


def test_ctrl_c_ends_a_run_with_its_report(start: Callable[..., Program], tmp_path: Path) -> None:
    out = tmp_path / "run.json"
    with (
        start(f"{MOTION}.server"),
        start(f"{MOTION}.client", "--duration", "60", "--json", out) as robot,
    ):
        wait_until(lambda: "last second" in robot.output())
        assert robot.interrupt() == 130, robot.output()
        assert "Traceback" not in robot.output()
    summary, _ = records(out)
    assert 0 < summary["sent"] < 600


def test_without_a_server_the_robot_says_so(start: Callable[..., Program]) -> None:
    with start(f"{HUMANS}.client", "--wait-s", "0.5", "--frames", "1") as robot:
        assert robot.wait() == 1
        assert "no server for /detect_people within 0.5 s" in robot.output()


@pytest.mark.parametrize("module", [f"{MOTION}.server", f"{MOTION}.client", f"{HUMANS}.server", f"{HUMANS}.client"])
def test_help_has_examples(start: Callable[..., Program], module: str) -> None:
    with start(module, "--help") as program:
        assert program.wait() == 0
        assert f"examples:\n  python -m {module}" in program.output()


def test_a_missing_photograph_is_a_usage_error(start: Callable[..., Program], tmp_path: Path) -> None:
    with start(f"{HUMANS}.client", "--image", tmp_path / "none.jpg") as robot:
        assert robot.wait() == 2
        assert "none.jpg: not a readable image" in robot.output()
