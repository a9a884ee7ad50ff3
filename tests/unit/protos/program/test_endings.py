"""How programs end when nobody reads them, at a full disk, and by Ctrl-C."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from plr.protos.program.endings import ends_quietly

pytestmark = pytest.mark.audit("ops-14")

ROOT = Path(__file__).parents[4]
PROGRAMS = [
    ["plr.protos.program.command_line", "config", "schema", "controlplane"],
    ["plr.sidecar", "--print-schema"],
]
FULL = Path("/dev/full")
WAITING = """
import sys, time
from plr.protos.program.endings import ended_by_ctrl_c, ends_quietly
@ends_quietly("plr")
def main():
    {how}: print("ready", flush=True); time.sleep(60)
    return 0
sys.exit(main())
"""


def run(argv: list[str], stdout: int | None, shell: str = "") -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", *argv]
    if shell:
        command = ["sh", "-c", f'exec "$@" {shell}', "sh", *command]
    return subprocess.Popen(command, stdout=stdout, stderr=subprocess.PIPE, cwd=ROOT)


@pytest.mark.parametrize("argv", PROGRAMS, ids=" ".join)
def test_a_reader_that_has_gone_is_no_error(argv: list[str]) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    with run(argv, writing) as program:
        os.close(writing)
        assert program.communicate(timeout=60)[1] == b""
    assert program.returncode == 141


@pytest.mark.skipif(not FULL.exists(), reason="needs /dev/full")
def test_a_full_disk_is_one_line() -> None:
    with FULL.open("wb") as full, run(PROGRAMS[0], full.fileno()) as program:
        assert program.communicate(timeout=60)[1] == (b"plr: its output cannot be written: No space left on device\n")
    assert program.returncode == 1


def test_no_standard_output_is_no_error() -> None:
    with run(PROGRAMS[0], None, ">&-") as program:
        assert program.communicate(timeout=60)[1] == b""
    assert program.returncode == 0


@pytest.mark.parametrize(("how", "code"), [("if True", 130), ("with ended_by_ctrl_c()", -signal.SIGINT)])
def test_ctrl_c_ends_without_a_trace(how: str, code: int) -> None:
    argv = [sys.executable, "-c", WAITING.format(how=how)]
    with subprocess.Popen(argv, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=ROOT) as program:
        assert program.stdout is not None
        assert program.stdout.readline() == b"ready\n"
        program.send_signal(signal.SIGINT)
        assert program.communicate(timeout=60)[1] == b""
    assert program.returncode == code


def test_no_file_of_ours_gets_the_number_of_a_standard_stream() -> None:
    code = "import os; from plr.protos.program.endings import ends_quietly; "
    code += "ends_quietly('plr')(lambda: 0)(); os._exit(os.dup(0))"
    with subprocess.Popen(
        ["sh", "-c", 'exec "$@" <&- >&- 2>&-', "sh", sys.executable, "-c", code], cwd=ROOT
    ) as program:
        assert program.wait(60) > 2


def test_another_error_and_the_end_of_argparse_pass() -> None:
    @ends_quietly("plr")
    def main(error: BaseException) -> int:
        raise error

    for error in (FileNotFoundError(2, "none", "file"), OSError(28, "full", "file"), SystemExit(2), ValueError()):
        with pytest.raises(type(error)):
            main(error)
