"""Runs the real control plane as a process of its own, under the limits of its unit, with its turns watched."""

from __future__ import annotations

import configparser
import json
import os
import resource
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.request import urlopen

import yaml

from bench.churn.machine import processor_s
from lab.host import DIE_WITH_PARENT
from plr.protos.trust.identity import IdentityRole

if TYPE_CHECKING:
    from plr.controlplane.ca import Authority

UNIT = Path("deploy/systemd/plr-controlplane.service")
USUAL_OPEN_FILES = 1024
"""systemd's limit for a unit that sets none."""
PATIENCE_S = 30.0


class PlaneError(RuntimeError):
    """The control plane did not do what it should; the text names its log."""


@dataclass(frozen=True, slots=True)
class Hold:
    """The longest turn of the event loop: seconds of processor time, of the clock, and what it ran."""

    cpu_s: float
    wall_s: float
    what: str


class Plane:
    """Starts, kills and observes one control plane; `folder` holds its files."""

    def __init__(self, folder: Path, authority: Authority, ports: tuple[int, int]) -> None:
        self._folder = folder
        self._port, self._metrics_port = ports
        self._turns = folder / "turns.json"
        self._process: subprocess.Popen[bytes] | None = None
        self._tls = self._certify(authority, IdentityRole.CONTROL_PLANE)
        self._operator = self._certify(authority, IdentityRole.OPERATOR)
        config = {
            "listen": f"127.0.0.1:{self._port}",
            "tls_dir": str(self._tls),
            "stun_listen": [],
            "metrics_listen": f"127.0.0.1:{self._metrics_port}",
            "state_dir": str(folder / "state"),
        }
        self._environment = {
            **os.environ,
            "PYTHONDONTWRITEBYTECODE": "",
            "PYTHONPYCACHEPREFIX": str(folder / "compiled"),
        }
        """An installed program is compiled; this one is compiled by its first start."""
        self._config = folder / "controlplane.yaml"
        self._config.write_text(yaml.safe_dump(config))

    def _certify(self, authority: Authority, role: IdentityRole) -> Path:
        folder = self._folder / role.value
        folder.mkdir()
        issued = authority.issue(role.value, role)
        files = {"ca.pem": authority.ca_pem, "cert.pem": issued.certificate_pem, "key.pem": issued.key_pem}
        for name, content in files.items():
            (folder / name).write_bytes(content)
            (folder / name).chmod(0o600)
        return folder

    @property
    def target(self) -> str:
        """The address on which it listens."""
        return f"127.0.0.1:{self._port}"

    @property
    def pid(self) -> int:
        """Its process ID."""
        assert self._process is not None
        return self._process.pid

    def start(self) -> float:
        """Start it with the unit's limit on open files; return when."""
        return self._start("bench.control.watched", str(self._turns), "--config", str(self._config))

    def start_bare(self, *what: str) -> float:
        """Start the anchor in its place; `what` are its arguments besides port and certificate."""
        return self._start("bench.control.bare", str(self._port), str(self._tls), *what)

    def _start(self, module: str, *arguments: str) -> float:
        limit = min(open_files_of(UNIT), resource.getrlimit(resource.RLIMIT_NOFILE)[1])
        command = [*DIE_WITH_PARENT, sys.executable, "-m", module, *arguments]
        began = time.monotonic()
        with (self._folder / "controlplane.log").open("ab") as log:
            self._process = subprocess.Popen(command, stdout=log, stderr=log, env=self._environment)
        # Set from outside, not between fork and exec: gRPC's threads of this process would be missing there.
        resource.prlimit(self._process.pid, resource.RLIMIT_NOFILE, (limit, limit))
        return began

    def kill(self) -> None:
        """Send SIGKILL, as if the power failed."""
        assert self._process is not None
        self._process.kill()
        self._process.wait()

    def lose_first_server(self) -> None:
        """Signal the anchor that its first server is dead."""
        os.kill(self.pid, signal.SIGUSR2)

    def processor_s(self) -> float:
        """Return the processor time that it has used."""
        return processor_s(self.pid)

    def resident_kb(self) -> int:
        """Return the memory that it holds."""
        text = Path(f"/proc/{self.pid}/status").read_text()
        return int(text.partition("VmRSS:")[2].split()[0])

    def hold(self) -> Hold:
        """Return the longest turn of its event loop since the last call."""
        self._turns.unlink(missing_ok=True)
        os.kill(self.pid, signal.SIGUSR1)
        give_up_at = time.monotonic() + PATIENCE_S
        while not self._turns.exists():
            if time.monotonic() > give_up_at:
                raise PlaneError(f"it does not answer; see {self._folder}")
            time.sleep(0.02)
        found = json.loads(self._turns.read_text())
        what = found["turns"][0][2] if found["turns"] else "nothing"
        return Hold(found["cpu_s"], found["wall_s"], what)

    def metric(self, name: str) -> float:
        """Return the value of a series, named with its labels as they are written."""
        with urlopen(f"http://127.0.0.1:{self._metrics_port}/metrics", timeout=PATIENCE_S) as answer:
            lines = answer.read().decode().splitlines()
        return sum(float(line.rpartition(" ")[2]) for line in lines if line.startswith(f"{name} "))

    def status_s(self) -> float:
        """Return how long `plr status` takes, from start to end."""
        command = [sys.executable, "-m", "plr.controlplane.cli", "status", "--address", self.target]
        began = time.monotonic()
        subprocess.run(
            [*command, "--tls-dir", str(self._operator)], check=True, stdout=subprocess.DEVNULL, timeout=PATIENCE_S
        )
        return time.monotonic() - began


def open_files_of(unit: Path) -> int:
    """Return how many open files a systemd unit allows its program."""
    parser = configparser.RawConfigParser(strict=False)
    parser.read_string(unit.read_text())
    return int(parser.get("Service", "LimitNOFILE", fallback=USUAL_OPEN_FILES))
