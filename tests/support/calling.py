"""Calls to /echo over a running system, and what its robot counts meanwhile."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from lab.system import read_json

if TYPE_CHECKING:
    from lab.system import System


class Call:
    """A client of /echo in the background."""

    def __init__(self, system: System, *options: str, module: str = "lab.echo call") -> None:
        self._out = system.folder / "call.json"
        self._out.unlink(missing_ok=True)
        self._system = system
        (system.folder / "client.log").unlink(missing_ok=True)
        # A client that a busy machine does not let run keeps no more answers than its queue holds, ours or any other's.
        queue = ["--queue-depth", "200"] if module.startswith("lab.echo") else []
        argv = ["-m", *module.split(), *queue, "--grace-s", "25", "--json", str(self._out), *options]
        self._part = system.start_node("client", "robot", argv)

    def wait_until_sending(self) -> None:
        self._system.wait("the client to call", lambda: " sent " in self._part.log.read_text())

    def interrupt(self) -> dict[str, Any]:
        """End it before its time; what it had asked for a moment before need not be answered."""
        self._part.terminate()
        del self._system.parts[self._part.name]
        return self.result()

    def result(self, timeout_s: float = 90.0) -> dict[str, Any]:
        self._part.process.wait(timeout_s)
        assert self._out.exists(), self._part.tail()
        return read_json(self._out)


def assert_flawless(run: dict[str, Any]) -> None:
    summary = run["summary"]
    assert summary["answered_once"] == summary["sent"] > 0, summary
    assert summary["missing"] == summary["answered_twice"] == summary["invalid"] == summary["strangers"] == 0, summary


def counter(system: System, name: str, **labels: str) -> float:
    return sum(
        value
        for series, value in system.metrics("robot").items()
        if series.partition("{")[0] == name and all(f'{key}="{wanted}"' in series for key, wanted in labels.items())
    )
