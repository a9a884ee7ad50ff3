"""What a user types wrong, or in a bad place, ends every program in one line: never a traceback, never a raw escape."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from importlib.metadata import entry_points
from typing import TYPE_CHECKING

import pytest

from plr.controlplane.__main__ import main as controlplane
from plr.controlplane.cli import __main__
from plr.protos.program.command_line import main as plr
from plr.sidecar.__main__ import main as sidecar
from tests.support.free_ports import free_port

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

pytestmark = pytest.mark.audit("ops-14")

ESCAPE = "\x1b[31mred"


def refused(run: Callable[[Sequence[str]], int], *arguments: str, capsys: pytest.CaptureFixture[str]) -> str:
    """Run a program that ends with 2; returns its one line."""
    try:
        code = run(arguments)
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    out, err = capsys.readouterr()
    assert code == 2, err
    assert out == ""
    assert err.endswith("\n")
    assert err[:-1].isprintable()
    return err


@pytest.mark.parametrize("run", [sidecar, controlplane])
def test_an_argument_is_repeated_without_its_escapes(
    run: Callable[[Sequence[str]], int], capsys: pytest.CaptureFixture[str]
) -> None:
    assert r"\x1b[31mred" in refused(run, "--config", "x", ESCAPE, capsys=capsys)


@pytest.mark.parametrize(
    "arguments",
    [
        ("doctor", ESCAPE),
        ("ca", "sign", "a", ESCAPE),
        ("status", "--insecure", ESCAPE),
        ("plan", "--traces", ESCAPE, "--deadline-ms", "1"),
        ("plan", "--traces", "a", "--deadline-ms", ESCAPE),
        ("events", "--insecure", "--since", ESCAPE),
        ("ping", "a", "-I", ESCAPE),
    ],
    ids=lambda arguments: arguments[0],
)
def test_so_do_the_commands_of_plr(arguments: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    assert r"\x1b[31mred" in refused(plr, *arguments, capsys=capsys)


@pytest.mark.parametrize("number", ["nan", "inf", "-1", "1" * 5000])
@pytest.mark.parametrize(
    "arguments",
    [
        ("status", "--insecure", "--timeout-s"),
        ("explain", "--insecure", "r", "/s", "--timeout-s"),
        ("events", "--insecure", "--last"),
        ("ping", "a", "-c"),
        ("ping", "a", "-i"),
        ("ping", "a", "-s"),
        ("ping", "a", "-W"),
        ("plan", "--traces", "a", "--target"),
        ("plan", "--traces", "a", "--request-bytes"),
        ("ca", "init", "--days"),
    ],
    ids=" ".join,
)
def test_no_option_takes_what_is_no_number_of_anything(
    arguments: tuple[str, ...], number: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert f"argument {arguments[-1]}" in refused(plr, *arguments, number, capsys=capsys).replace("/--", " --")


def test_what_is_no_name_is_bad_usage(capsys: pytest.CaptureFixture[str]) -> None:
    assert "the name 'x y' is not" in refused(plr, "ping", "x y", capsys=capsys)
    assert "longer than an interface's" in refused(plr, "ping", "a", "-I", "a" * 16, capsys=capsys)


def test_a_mistyped_command_is_told_all_that_there_are(capsys: pytest.CaptureFixture[str]) -> None:
    told = refused(plr, "statuz", capsys=capsys)
    assert all(f"'{name}'" in told for name in ("status", "ca", "doctor", "ping", "bugreport"))
    assert "COMMAND" in refused(__main__.main, "--", "status", capsys=capsys)


def test_who_asks_is_told_what_to_name(capsys: pytest.CaptureFixture[str]) -> None:
    told = refused(plr, "status", capsys=capsys)
    assert "expected --tls-dir DIR" in told
    assert "plr ca issue" in told


def test_the_stun_port_is_no_control_plane(capsys: pytest.CaptureFixture[str]) -> None:
    assert plr(["status", "--insecure", "--address", f"127.0.0.1:{free_port()}"]) == 1
    assert "nothing listens on this TCP port" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "told"), [("fifo", "not a regular file"), ("a" * 300, "name too long"), ("none", "No such file")]
)
def test_a_trace_or_recording_that_is_none_is_not_waited_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, told: str
) -> None:
    os.mkfifo(tmp_path / "fifo")
    path = str(tmp_path / name)
    for arguments in (("plan", "--recorded", path), ("plan", "--traces", path, "--deadline-ms", "9")):
        assert told in refused(plr, *arguments, capsys=capsys)


PRINTS = """
    import sys
    from plr.protos.program.endings import ends_quietly
    sys.exit(ends_quietly("plr")(lambda: print("\\u65e5\\u2026\\udcff") or 0)())
"""


@pytest.mark.parametrize(
    "locale",
    [
        {"PYTHONIOENCODING": "iso-8859-1"},
        {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
        {"PYTHONIOENCODING": "ascii:strict"},
    ],
    ids=["latin-1", "C", "ascii"],
)
def test_what_the_locale_has_no_character_for_is_escaped(locale: dict[str, str]) -> None:
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(PRINTS)], env={**os.environ, **locale}, capture_output=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, b"\\u65e5\\u2026\\udcff\n", b"")


BEGINS = """
    import os, signal, sys
    from plr.protos.program.entry import end_by_ctrl_c
    {before}
    end_by_ctrl_c()
    os.kill(os.getpid(), signal.SIGINT)
    from plr.protos.program.endings import ends_quietly
    @ends_quietly("plr")
    def main():
        os.kill(os.getpid(), signal.SIGINT)
        return 7
    sys.exit(main())
"""


def from_a_terminal(script: str) -> subprocess.CompletedProcess[bytes]:
    """Run a script that Ctrl-C reaches, also where the tests themselves run in the background and ignore it."""
    begin = (
        "import os, signal, sys; signal.signal(signal.SIGINT, signal.SIG_DFL); os.execv(sys.executable, sys.argv[1:])"
    )
    command = [sys.executable, "-c", begin, sys.executable, "-c", script]
    return subprocess.run(command, capture_output=True, check=False)


@pytest.mark.parametrize(("before", "code"), [("", -2), ("signal.signal(signal.SIGINT, signal.SIG_IGN)", 7)])
def test_ctrl_c_among_the_imports_ends_without_a_word(before: str, code: int) -> None:
    """One that was started in the background, which ignores it, goes on doing so."""
    done = from_a_terminal(textwrap.dedent(BEGINS).format(before=before))
    assert (done.returncode, done.stderr) == (code, b"")


def test_ctrl_c_is_answered_once_the_program_runs() -> None:
    script = textwrap.dedent(BEGINS).format(before="").replace("os.kill", "pass; os.kill", 1)
    script = script.replace("pass; os.kill(os.getpid(), signal.SIGINT)", "pass")
    done = from_a_terminal(script)
    assert (done.returncode, done.stderr) == (130, b"")


def test_plr_lists_the_commands_of_the_sidecar() -> None:
    installed = {each.name for each in entry_points(group="plr.commands")}
    assert set(__main__._ON_A_NODE) == installed - {"operator"}
