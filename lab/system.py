"""Runs the whole real system in the network lab: control plane, cloud servers, robots, each in its own process.

The demo, the lab tests and the benchmarks use it. Nothing here is a stand-in: the processes are the installed
programs and the unmodified examples.
"""

from __future__ import annotations

import json
import signal
import socket
import sys
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import yaml
from google.protobuf import json_format

from plr.controlplane.ca import Authority
from plr.protos.convert import explanation_from_proto
from plr.protos.plr.v1 import admin_pb2
from plr.protos.trust.identity import IdentityRole

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from lab import Host, HostProcess, Lab
    from plr.protos.model.explanation import Explanation

CONTROL_PORT = 50051
STUN_PORT = 3478
METRICS_PORT = 9464
CONTROL_METRICS_PORT = 9465
METRICS_TIMEOUT_S = 2.0
READY_TIMEOUT_S = 60.0
"""Time limit for a start: Python with rclpy, numpy and OR-Tools on two shared cores takes seconds."""


class SystemFailureError(RuntimeError):
    """A part of the system did not do what it should; the text names its log."""


@dataclass(slots=True)
class Part:
    """One running program."""

    name: str
    host: Host
    process: HostProcess
    log: Path

    def kill(self) -> None:
        """Send SIGKILL, as if the power failed."""
        self.host.kill(self.process, signal.SIGKILL)

    def terminate(self, timeout_s: float = 20.0) -> int:
        """Send SIGTERM and return the exit code."""
        return self.host.kill(self.process, signal.SIGTERM, timeout=timeout_s)

    def tail(self, lines: int = 15) -> str:
        """Return the end of its log."""
        return "\n".join(self.log.read_text(errors="replace").splitlines()[-lines:])


@dataclass(slots=True)
class System:
    """Starts and stops the parts; `folder` holds configurations, state and logs."""

    lab: Lab
    folder: Path
    parts: dict[str, Part] = field(default_factory=dict)
    authority: Authority = field(default_factory=Authority.create)
    """The CA of this fleet."""
    _certified: set[str] = field(default_factory=set)

    # -- parts ----------------------------------------------------------------------------------------------------

    def start_control_plane(self, **changes: Any) -> Part:
        """Start plr-controlplane on the host `control`."""
        host = self.lab.host("control")
        config = {
            "tls_dir": self.tls_dir("control", IdentityRole.CONTROL_PLANE),
            "listen": f"0.0.0.0:{CONTROL_PORT}",
            "stun_listen": [f"0.0.0.0:{STUN_PORT}"],
            "stun_servers": [f"{host.address()}:{STUN_PORT}"],
            "metrics_listen": f"127.0.0.1:{CONTROL_METRICS_PORT}",
            **changes,
        }
        return self._start("controlplane", host, "plr.controlplane", self._write("controlplane", config))

    def start_cloud(
        self, name: str, services: Sequence[dict[str, Any]], *, module: str = "plr.sidecar", **changes: Any
    ) -> Part:
        """Start a cloud's sidecar (or its replacement); `services` as in its configuration."""
        config = {
            "name": name.replace("_", "-"),
            "role": "cloud",
            "tls_dir": self.tls_dir(name.replace("_", "-"), IdentityRole.CLOUD),
            "control_plane": f"{self.lab.host('control').address()}:{CONTROL_PORT}",
            "interfaces": ["eth0"],
            "state_dir": str(self.folder / f"{name}.state"),
            "metrics_listen": f"127.0.0.1:{METRICS_PORT}",
            "services": list(services),
            **changes,
        }
        return self._start(f"{name}.sidecar", self.lab.host(name), module, self._write(f"{name}.sidecar", config))

    def start_robot(
        self,
        services: Sequence[dict[str, Any]],
        *,
        name: str = "robot",
        host: str = "robot",
        interfaces: Sequence[str] = ("wlan0", "wwan0"),
        domain: int = 0,
        metrics_port: int = METRICS_PORT,
        module: str = "plr.sidecar",
        **changes: Any,
    ) -> Part:
        """Start a robot's sidecar (or its replacement) in a ROS domain of its host."""
        config = {
            "name": name,
            "role": "robot",
            "tls_dir": self.tls_dir(name, IdentityRole.ROBOT),
            "control_plane": f"{self.lab.host('control').address()}:{CONTROL_PORT}",
            "interfaces": list(interfaces),
            "state_dir": str(self.folder / f"{name}.state"),
            "metrics_listen": f"127.0.0.1:{metrics_port}",
            "services": list(services),
            **changes,
        }
        written = self._write(f"{name}.sidecar", config)
        return self._start(f"{name}.sidecar", self.lab.host(host), module, written, domain=domain)

    def tls_dir(self, name: str, role: IdentityRole) -> str:
        """Return the folder with the certificate of this name, which is issued at the first call."""
        path = self.folder / f"{name}.tls"
        if name not in self._certified:
            self.authority.write_tls_dir(path, name, role)
            self._certified.add(name)
        return str(path)

    def start_node(self, name: str, host: str, argv: Sequence[str], *, domain: int = 0) -> Part:
        """Start a ROS program (`python -m ...`) on a host."""
        return self._popen(name, self.lab.host(host), [sys.executable, *argv], domain)

    def _start(self, name: str, host: Host, module: str, config: Path, *, domain: int = 0) -> Part:
        return self._popen(name, host, [sys.executable, "-m", module, "--config", str(config)], domain)

    def _popen(self, name: str, host: Host, argv: Sequence[str], domain: int) -> Part:
        log = self.folder / f"{name}.log"
        environment = {"ROS_DOMAIN_ID": str(domain), "PYTHONUNBUFFERED": "1"}
        process = host.popen(argv, env=environment, log_path=log)
        part = self.parts[name] = Part(name, host, process, log)
        return part

    def _write(self, name: str, config: dict[str, Any]) -> Path:
        path = self.folder / f"{name}.yaml"
        path.write_text(yaml.safe_dump(config, sort_keys=False))
        (self.folder / f"{name.removesuffix('.sidecar')}.state").mkdir(exist_ok=True, mode=0o700)
        return path

    # -- waiting and looking --------------------------------------------------------------------------------------

    def wait(self, what: str, done: Callable[[], bool], timeout_s: float = READY_TIMEOUT_S) -> None:
        """Wait until `done`; raises SystemFailureError with the logs' ends if a program dies or the time is over."""
        end = time.monotonic() + timeout_s
        while not done():
            dead = [part for part in self.parts.values() if part.process.poll() not in (None, 0, -signal.SIGKILL)]
            if dead or time.monotonic() > end:
                why = f"{dead[0].name} ended with {dead[0].process.returncode}" if dead else f"not in {timeout_s:g} s"
                logs = "\n".join(f"--- {part.log}\n{part.tail()}" for part in dead or self.parts.values())
                raise SystemFailureError(f"waiting for {what}: {why}\n{logs}")
            time.sleep(0.1)

    def metrics(self, host: str, port: int = METRICS_PORT) -> dict[str, float]:
        """Scrape a program's metrics as series with labels -> value; empty while it does not answer."""
        try:
            with self.lab.host(host).socket(kind=socket.SOCK_STREAM) as connection:
                connection.settimeout(METRICS_TIMEOUT_S)
                connection.connect(("127.0.0.1", port))
                connection.sendall(b"GET /metrics HTTP/1.0\r\n\r\n")
                answer = b"".join(iter(lambda: connection.recv(1 << 16), b""))
        except OSError:
            return {}
        head, _, body = answer.partition(b"\r\n\r\n")
        if b" 200 " not in head.partition(b"\r\n")[0]:
            return {}
        found = {}
        for line in body.decode().splitlines():
            if line and not line.startswith("#"):
                series, _, value = line.rpartition(" ")
                found[series] = float(value)
        return found

    def explain(self, robot: str, service: str) -> Explanation:
        """Return what `plr explain` says; raises SystemFailureError."""
        host = self.lab.host("control")
        argv = [
            sys.executable,
            "-m",
            "plr.controlplane.cli",
            "explain",
            robot,
            service,
            "--json",
            "--timeout-s",
            "20",
        ]
        argv += ["--tls-dir", self.tls_dir("operator", IdentityRole.OPERATOR)]
        done = host.run([*argv, "--address", f"{host.address()}:{CONTROL_PORT}"], timeout=60.0)
        if done.returncode:
            raise SystemFailureError(f"plr explain: {done.stderr}")
        return explanation_from_proto(json_format.Parse(done.stdout, admin_pb2.ExplainResponse()))

    def wait_for_offer(self, part: Part, services: int = 1) -> None:
        """Wait until a robot's sidecar offers this many services (by its log)."""
        self.wait(
            f"{part.name} to offer {services} service(s)",
            lambda: part.log.read_text(errors="replace").count(" is offered here") >= services,
        )

    def close(self) -> None:
        """Ask every program to end, the robots' clients first, and kill those that do not."""
        for part in reversed(list(self.parts.values())):
            if part.process.poll() is None:
                try:
                    part.terminate(10.0)
                except Exception:  # a hung program must not keep the lab alive
                    part.kill()


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object."""
    content: dict[str, Any] = json.loads(path.read_text())
    return content
