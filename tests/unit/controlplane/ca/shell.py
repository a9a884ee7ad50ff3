"""`plr` as a user meets it."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
from pathlib import Path

import pytest

from plr.controlplane.cli import __main__


class Shell:
    """Runs `plr ca` in a folder of its own."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys
        self.warnings: list[str] = []
        """What the last command warned of."""

    def __call__(self, *arguments: str, code: int = 0) -> str:
        """Return what it prints, or what it complains of."""
        return self.run("ca", *arguments, code=code)

    def run(self, *arguments: str, code: int = 0) -> str:
        """The same of any `plr`."""
        assert __main__.main(arguments) == code
        printed = self._capsys.readouterr()
        lines = printed.err.splitlines(keepends=True)
        self.warnings = [line for line in lines if line.startswith("plr: warning: ")]
        errors = [line for line in lines if line not in self.warnings]
        if not code:
            assert not errors
            return printed.out
        assert printed.out == ""
        (error,) = errors
        assert error.startswith("plr: ")
        return error

    def usage(self, *arguments: str) -> str:
        with pytest.raises(SystemExit) as caught:
            __main__.main(["ca", *arguments])
        assert caught.value.code == 2
        return self._capsys.readouterr().err


def at_a_terminal(folder: Path, typed: str, *arguments: str) -> tuple[int, str, str]:
    """Run `plr ca` with a terminal at which somebody types; returns its exit code, what it says, and the echo."""
    ours, theirs = pty.openpty()
    command = [sys.executable, "-m", "plr.controlplane.cli", "ca", *arguments]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[4])}
    # A session of its own has no other terminal than this.
    with subprocess.Popen(
        command,
        stdin=theirs,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        cwd=folder,
        env=environment,
        start_new_session=True,
        text=True,
    ) as process:
        os.close(theirs)
        assert process.stderr is not None
        said = ""
        for line in typed.splitlines(keepends=True):
            # What is typed before the prompt would be echoed, and thrown away with it.
            while not said.endswith(": "):
                letter = process.stderr.read(1)
                assert letter, said
                said += letter
            os.write(ours, line.encode())
            said += "|"
        out, rest = process.communicate(timeout=60)
    os.set_blocking(ours, False)
    try:
        echo = os.read(ours, 4096).decode()
    except OSError:
        echo = ""
    os.close(ours)
    return process.returncode, said + rest + out, echo
