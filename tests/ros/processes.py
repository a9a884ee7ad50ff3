"""Programs as a user starts them: a ROS process of this environment, in its own domain, never outliving the test."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path
    from types import TracebackType

ROOT = __file__.rsplit("/tests/", 1)[0]
END_S = 30.0


class Program:
    """A running `python ARGUMENTS`. Its output goes to `<name>.out` in `folder`."""

    def __init__(
        self,
        name: str,
        arguments: Sequence[str | Path],
        domain: int,
        folder: Path,
        environment: Mapping[str, str] | None = None,
    ) -> None:
        """`environment`: what is added to this process's."""
        self.output_path = folder / f"{name}.out"
        with self.output_path.open("w") as output:
            self._process = subprocess.Popen(
                [sys.executable, *arguments],
                cwd=ROOT,
                env={
                    **os.environ,
                    "ROS_DOMAIN_ID": str(domain),
                    "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
                    "ROS_LOG_DIR": str(folder / "ros-logs"),
                    **(environment or {}),
                },
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
            )

    def __enter__(self) -> Program:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.kill()
        self._process.wait()

    def output(self) -> str:
        """What it has printed so far, errors included."""
        return self.output_path.read_text()

    def wait(self, timeout_s: float = END_S) -> int:
        """Its exit code, once it has ended by itself."""
        return self._process.wait(timeout_s)

    def interrupt(self) -> int:
        """Press Ctrl-C; its exit code."""
        return self.stop(signal.SIGINT)

    def send(self, number: signal.Signals) -> None:
        """Send a signal that does not end it."""
        self._process.send_signal(number)

    def stop(self, by: signal.Signals, timeout_s: float = END_S) -> int:
        """Send a signal; its exit code (negative: the signal that ended it)."""
        self._process.send_signal(by)
        return self.wait(timeout_s)
