"""Controls programs over their stdin and stdout: one JSON object a line, an answer for each question.

The controller's side is `Remote`; the program's side is `serve`, given an object whose methods are the questions.
A program ends when its stdin closes.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import subprocess
import sys
import time
import traceback
from typing import TYPE_CHECKING, Any, Protocol, Self

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path
    from types import TracebackType

    from lab import Host

ANSWER_TIMEOUT_S = 60.0
END_TIMEOUT_S = 5.0
_READ_BYTES = 1 << 16


class RemoteError(RuntimeError):
    """The program did not answer, or answered with an error; the text says which."""


class Program(Protocol):
    """A program for `serve`: besides `close`, every public method is a question that the controller may ask."""

    def close(self) -> None:
        """End, because the controller is gone."""


class Remote:
    """A running program. Use it in a `with` block, from one thread."""

    def __init__(self, name: str, process: subprocess.Popen[bytes], log: Path) -> None:
        self.name = name
        self._process = process
        self._log = log
        self._read = b""

    @classmethod
    def start(
        cls,
        module: str,
        folder: Path,
        *,
        host: Host | None = None,
        name: str | None = None,
        environment: Mapping[str, str] | None = None,
        before: Sequence[str] = (),
    ) -> Remote:
        """Run `python -m bench.dataplane.programs.MODULE` on this host or on one of the lab; logs go to `folder`.

        `environment` is added to the program's environment. `before` is a command that starts it.
        """
        name = name or module
        argv = [*before, sys.executable, "-m", f"bench.dataplane.programs.{module}"]
        log = folder / f"{name}.log"
        pipe = subprocess.PIPE
        with log.open("ab") as errors:
            if host is None:
                process = subprocess.Popen(
                    argv,
                    stdin=pipe,
                    stdout=pipe,
                    stderr=errors,
                    start_new_session=True,
                    env={**os.environ, **(environment or {})},
                )
            else:
                process = host.popen(argv, stdin=pipe, stdout=pipe, stderr=errors, env=environment)
        return cls(name, process, log)

    def ask(self, question: str, *, timeout_s: float = ANSWER_TIMEOUT_S, **fields: Any) -> Any:
        """Ask and wait for the answer; raises RemoteError."""
        self.begin(question, **fields)
        return self.finish(timeout_s)

    def begin(self, question: str, **fields: Any) -> None:
        """Ask; `finish` gets the answer, and the program works meanwhile. Raises RemoteError."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps({"question": question, **fields}).encode() + b"\n")
            self._process.stdin.flush()
        except OSError as error:
            raise RemoteError(f"{self.name}: {error}\n{self._last_words()}") from error

    def ready(self, timeout_s: float) -> bool:
        """Return whether the answer to what was begun comes, or the program ends, within this time."""
        assert self._process.stdout is not None
        return b"\n" in self._read or bool(select.select([self._process.stdout], [], [], max(0.0, timeout_s))[0])

    def finish(self, timeout_s: float = ANSWER_TIMEOUT_S) -> Any:
        """Return the answer to what was begun; raises RemoteError."""
        answer = json.loads(self._read_line(time.monotonic() + timeout_s))
        if "error" in answer:
            raise RemoteError(f"{self.name}: {answer['error']}")
        return answer["answer"]

    def close(self) -> None:
        """End the program; may be called again."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        with contextlib.suppress(OSError):
            self._process.stdin.close()
        try:
            self._process.wait(END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _read_line(self, end: float) -> bytes:
        assert self._process.stdout is not None
        descriptor = self._process.stdout.fileno()
        while b"\n" not in self._read:
            ready, _, _ = select.select([descriptor], [], [], max(0.0, end - time.monotonic()))
            if not ready:
                raise RemoteError(f"{self.name}: no answer in time\n{self._last_words()}")
            data = os.read(descriptor, _READ_BYTES)
            if not data:
                raise RemoteError(f"{self.name}: it ended\n{self._last_words()}")
            self._read += data
        line, _, self._read = self._read.partition(b"\n")
        return line

    def _last_words(self) -> str:
        return "\n".join(self._log.read_text(errors="replace").splitlines()[-15:])


def serve(program: Program) -> None:
    """Answer the controller's questions until it closes the pipe."""
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # output of a library must not mix with the answers
    try:
        for line in sys.stdin:
            fields = json.loads(line)
            try:
                answer = {"answer": getattr(program, fields.pop("question"))(**fields)}
            except Exception as error:
                traceback.print_exc()
                answer = {"error": f"{type(error).__name__}: {error}"}
            out.write(json.dumps(answer).encode() + b"\n")
            out.flush()
    finally:
        program.close()
