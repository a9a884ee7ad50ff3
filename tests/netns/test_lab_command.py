"""`python -m lab`."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import IO

import pytest

pytestmark = pytest.mark.netns
REPOSITORY = Path(__file__).resolve().parents[2]


def lab_command(*arguments: str, typed: str = "") -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-S", "-m", "lab", *arguments],
        input=typed,
        capture_output=True,
        text=True,
        cwd=REPOSITORY,
        timeout=60,
        check=False,
    )


def test_help_shows_examples() -> None:
    done = lab_command("--help")
    assert done.returncode == 0
    assert "python -m lab shell robot" in done.stdout


def test_program_runs_on_a_host_and_gives_its_exit_code() -> None:
    done = lab_command("--link", "wlan0:delay_ms=1", "exec", "cloud_b", "--", "sh", "-c", "uname -n; exit 7")
    assert (done.stdout, done.returncode) == ("cloud-b\n", 7)


def test_typed_commands_change_the_lab_and_show_in_the_statistics(tmp_path: Path) -> None:
    trace = tmp_path / "trace.csv"
    trace.write_text(
        "t_s,a_up_kbps,a_down_kbps,a_rtt_ms,a_loss,b_up_kbps,b_down_kbps,b_rtt_ms,b_loss\n0,100,200,60,0,300,400,52,0\n"
    )
    command = [sys.executable, "-S", "-m", "lab", "--trace", str(trace), "up", "--every", "0.1"]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=REPOSITORY, bufsize=1
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            await_line(process.stdout, "robot/wwan0 | up 0 kbit/s of 300, 26 ms")
            process.stdin.write("wlan0 blackhole\nwwan0 delay_ms=7\nwwan0 rebind\nwlan0 explode\nhelp\n")
            await_line(process.stdout, "expected one of")
            await_line(process.stdout, "the NAT router forgets its mappings")
            await_line(process.stdout, "robot/wlan0 BLACKHOLE")
            await_line(process.stdout, "robot/wwan0 | up 0 kbit/s of 300, 7 ms")
            process.stdin.write("quit\n")
            assert process.wait(20) == 0
        finally:
            process.kill()


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("--link", "wlan0:loss=2", "exec", "robot", "true"), 2, "loss: expected a probability"),
        (("--link", "wlan0"), 2, "what to do with it"),
        (("--clouds", "0"), 2, "clouds: expected"),
        (("--trace", "/nonexistent"), 2, "/nonexistent"),
        (("--paths", "wlan0"), 2, "--paths"),
        (("exec", "robot"), 2, "expected a command"),
        (("exec", "mars", "--", "true"), 1, "no machine 'mars'"),
        (("--link", "wlan5:loss=0", "exec", "robot", "true"), 1, "wlan5"),
    ],
)
def test_mistakes_are_told_in_one_line(arguments: tuple[str, ...], code: int, message: str) -> None:
    done = lab_command(*arguments)
    assert done.returncode == code
    assert message in done.stderr
    assert done.stderr.count("\n") == 1


def await_line(stream: IO[str], text: str) -> None:
    """Read on until a line contains `text`; the test's time limit is the limit."""
    for line in stream:
        if text in line:
            return
    raise AssertionError(f"never said: {text}")
