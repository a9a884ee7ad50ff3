"""The lab's machines: what programs find there, and how they are started and killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from lab import Lab, LabConfig, LabError, LinkProfile
from lab.calibrate import calibrate
from tests.netns.lab_traffic import PATIENCE_S

pytestmark = pytest.mark.netns
SMALL = LabConfig.of(interfaces=("wlan0",), clouds=1)


def test_each_host_has_its_own_name_and_shared_memory(lab: Lab) -> None:
    for name in ("robot", "cloud_a"):
        host = lab.host(name)
        assert host.run(["uname", "-n"]).stdout.strip() == name.replace("_", "-")
        host.run(["sh", "-c", 'test -z "$(ls /dev/shm)" && touch /dev/shm/mine'], check=True)
    assert not Path("/dev/shm/mine").exists()


def test_programs_see_the_callers_files_directory_and_environment(
    lab: Lab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FROM_CALLER", "yes")
    monkeypatch.setenv("UNWANTED", "yes")
    robot = lab.host("robot")
    assert robot.run(["pwd"]).stdout.strip() == os.getcwd()
    assert robot.run(["pwd"], cwd=tmp_path).stdout.strip() == str(tmp_path)
    environment = robot.run(["env"], env={"MORE": "1", "UNWANTED": None}).stdout.splitlines()
    assert {"FROM_CALLER=yes", "MORE=1", "ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST"} <= set(environment)
    assert "UNWANTED=yes" not in environment
    done = robot.run([sys.executable, "-c", "import sys, pytest; print(sys.prefix)"], check=True)
    assert done.stdout.strip() == sys.prefix


def test_output_goes_to_the_log(lab: Lab, tmp_path: Path) -> None:
    log = tmp_path / "log"
    for word in ("one", "two"):
        process = lab.host("robot").popen(["sh", "-c", f"echo {word}; echo {word}! >&2"], log_path=log)
        assert process.wait(PATIENCE_S) == 0
    assert log.read_text().split() == ["one", "one!", "two", "two!"]


def test_return_codes_input_and_timeouts_are_passed_on(lab: Lab) -> None:
    robot = lab.host("robot")
    assert robot.run(["sh", "-c", "exit 7"]).returncode == 7
    assert robot.run(["cat"], input="häß\n").stdout == "häß\n"
    with pytest.raises(subprocess.CalledProcessError):
        robot.run(["false"], check=True)
    with pytest.raises(subprocess.TimeoutExpired):
        robot.run(["sleep", "100"], timeout=0.1)
    assert "sleep" not in robot.run(["ps", "-A", "-o", "comm"]).stdout


def test_signals_reach_the_program_itself(lab: Lab) -> None:
    cloud = lab.host("cloud_a")
    assert cloud.kill(cloud.popen(["sleep", "100"])) == -signal.SIGKILL
    assert cloud.kill(cloud.popen(["sleep", "100"]), signal.SIGTERM) == -signal.SIGTERM
    process = cloud.popen(
        ["sh", "-c", "trap 'exit 3' TERM; echo ready; while :; do sleep 0.01; done"], stdout=subprocess.PIPE
    )
    assert process.stdout is not None
    assert process.stdout.readline() == b"ready\n"
    process.terminate()
    assert process.wait(PATIENCE_S) == 3
    process.terminate()  # harmless
    process.stdout.close()


def test_stopped_program_can_be_continued_and_killed(lab: Lab) -> None:
    cloud = lab.host("cloud_a")
    process = cloud.popen(["cat"], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdin is not None
    assert process.stdout is not None
    process.send_signal(signal.SIGSTOP)
    process.send_signal(signal.SIGCONT)
    process.stdin.write(b"on\n")
    process.stdin.flush()
    assert process.stdout.readline() == b"on\n"
    process.send_signal(signal.SIGSTOP)
    assert cloud.kill(process) == -signal.SIGKILL
    process.stdin.close()
    process.stdout.close()


def test_stopped_program_does_not_hold_up_the_end() -> None:
    with Lab(SMALL) as lab:
        process = lab.host("robot").popen(["sleep", "100"])
        process.send_signal(signal.SIGSTOP)
        await_state(process.inner_pid, "T")
        await_state(process.pid, "T")
        began = time.monotonic()
    assert process.returncode == -signal.SIGKILL
    assert time.monotonic() - began < PATIENCE_S


def await_state(pid: int | None, state: str) -> None:
    """Wait until /proc shows a process in a state."""
    deadline = time.monotonic() + PATIENCE_S
    while f"State:\t{state}" not in Path(f"/proc/{pid}/status").read_text():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_names_of_servers_are_known_on_every_host(lab: Lab) -> None:
    found = lab.host("robot").run(["getent", "ahosts", "cloud_b"], check=True).stdout
    assert lab.host("cloud_b").address() in found
    assert lab.host("cloud_b").address(family=6) in found


def test_lab_belongs_to_no_thread() -> None:
    labs: list[Lab] = []

    def bring_up() -> None:
        labs.append(Lab(SMALL).__enter__())

    thread = threading.Thread(target=bring_up)
    thread.start()
    thread.join()
    time.sleep(0.05)
    try:
        assert labs[0].host("robot").run(["true"]).returncode == 0
    finally:
        labs[0].close()
        labs[0].close()  # harmless


def test_dead_emulator_is_an_error_not_a_silence() -> None:
    with Lab(SMALL) as lab:
        link = lab.link("wlan0")
        lab.host("internet").run(["sh", "-c", "kill -9 $(pgrep ^link:wlan0)"], check=True)
        with pytest.raises(LabError, match="emulator has died"):
            link.set(LinkProfile())


def test_unknown_parts_are_named(lab: Lab) -> None:
    with pytest.raises(LabError, match="no machine 'mars'"):
        lab.host("mars")
    with pytest.raises(LabError, match="wlan7; there are: robot/wlan0"):
        lab.link("wlan7")
    with pytest.raises(LabError, match="control/wlan0"):
        lab.nat("wlan0", host="control")
    with pytest.raises(LabError, match="no IPv4 address on wlan9"):
        lab.host("robot").link_down("wlan9")
    with pytest.raises(LabError, match="robot"):
        lab.host("robot").ip_batch(["no such command"])
    with pytest.raises(LabError, match="No such device"):
        lab.host("robot").socket(device="nothing")


def test_refused_lab_says_why_and_leaves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lab.plan.router_rules", lambda _: "nonsense")
    lab = Lab(SMALL)
    with pytest.raises(LabError, match=r"could not be built: nft(?s:.*)nonsense"), lab:
        pass
    with pytest.raises(LabError, match="no machine"):
        lab.host("robot")
    monkeypatch.setattr("lab.lab._NEEDED_PROGRAMS", ("ip", "no-such-program"))
    with pytest.raises(LabError, match="not installed: no-such-program"), Lab(SMALL):
        pass


def test_calibration_measures_something() -> None:
    with Lab(SMALL) as lab:
        result = calibrate(lab, "wlan0", seconds=0.3, round_trips=200)
    assert result.packets_per_s > 1000
    assert 0 < result.cpu_share <= 1.1
    assert result.port_kind in ("tap", "packet")
