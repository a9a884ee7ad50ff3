"""Runs Prometheus and Alertmanager with the files of deploy/, sped up, and a receiver that keeps the notifications."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import threading
import time
from collections import Counter
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.error import URLError
from urllib.parse import quote
from urllib.request import urlopen

import yaml

if TYPE_CHECKING:
    from collections.abc import Iterator

FILES = Path("deploy/prometheus")
PATIENCE_S = 30.0
_UNITS_S = {"s": 1, "m": 60, "h": 3600}


class MonitoringError(RuntimeError):
    """A program did not start, or does not answer; the text names its log."""


@dataclass(frozen=True, slots=True)
class Notification:
    """One message to a receiver."""

    receiver: str
    firing: tuple[str, ...]
    """Name and labels of each firing alert."""
    links: tuple[str, ...]
    """Targets of their runbook_url."""


@dataclass(frozen=True, slots=True)
class Ports:
    """The ports of all programs, on loopback."""

    prometheus: int
    alertmanager: int
    cluster: int


class Monitoring:
    """Both programs, started by `start` and ended by `close`; `pace` divides the waits of rules and Alertmanager."""

    def __init__(self, folder: Path, scraped: int, ports: Ports, *, scrape_s: float, pace: float) -> None:
        self.notifications: list[Notification] = []
        self._folder = folder
        self._ports = ports
        self.pages = ""
        """Common prefix of every runbook_url."""
        self._processes: list[subprocess.Popen[bytes]] = []
        self._receiver = ThreadingHTTPServer(("127.0.0.1", 0), self._handler())
        threading.Thread(target=self._receiver.serve_forever, daemon=True).start()
        self._write_rules(pace)
        self._write_prometheus(scraped, scrape_s)
        self._write_alertmanager(pace)

    def _handler(self) -> type[BaseHTTPRequestHandler]:
        notifications = self.notifications

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                told = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
                alerts = [alert for alert in told["alerts"] if alert["status"] == "firing"]
                firing = tuple(_text(alert["labels"]) for alert in alerts)
                links = tuple(alert["annotations"]["runbook_url"] for alert in alerts)
                notifications.append(Notification(told["receiver"], firing, links))
                self.send_response(200)
                self.end_headers()

            def log_message(self, format: str, *args: Any) -> None:
                pass

        return Handler

    def _write_rules(self, pace: float) -> None:
        rules = yaml.safe_load((FILES / "plr-rules.yml").read_text())
        for group in rules["groups"]:
            for rule in group["rules"]:
                if "for" in rule:
                    rule["for"] = _faster(rule["for"], pace)
        (self._folder / "plr-rules.yml").write_text(yaml.safe_dump(rules))

    def _write_prometheus(self, scraped: int, scrape_s: float) -> None:
        config = yaml.safe_load((FILES / "prometheus.yml").read_text())
        milliseconds = f"{scrape_s * 1000:.0f}ms"
        config["global"] |= {
            "scrape_interval": milliseconds,
            "scrape_timeout": milliseconds,
            "evaluation_interval": "1s",
        }
        self.pages = str(config["global"]["external_labels"]["plr_docs"])
        config["alerting"]["alertmanagers"][0]["static_configs"][0]["targets"] = [_local(self._ports.alertmanager)]
        job = next(job for job in config["scrape_configs"] if job["job_name"] == "plr-controlplane")
        job["static_configs"][0]["targets"] = [_local(scraped)]
        config["scrape_configs"] = [job]
        (self._folder / "prometheus.yml").write_text(yaml.safe_dump(config))

    def _write_alertmanager(self, pace: float) -> None:
        config = yaml.safe_load((FILES / "alertmanager.yml").read_text())
        for key in ("group_wait", "group_interval"):
            config["route"][key] = _faster(config["route"][key], pace)
        for receiver in config["receivers"]:
            receiver["webhook_configs"] = [{"url": f"http://{_local(self._receiver.server_port)}"}]
        (self._folder / "alertmanager.yml").write_text(yaml.safe_dump(config))

    def start(self) -> None:
        """Start both, and wait until they answer; raises MonitoringError."""
        ports = self._ports
        self._run(
            "prometheus",
            "--config.file=prometheus.yml",
            "--storage.tsdb.path=tsdb",
            f"--web.listen-address={_local(ports.prometheus)}",
        )
        self._run(
            "prometheus-alertmanager",
            "--config.file=alertmanager.yml",
            "--storage.path=notified",
            f"--web.listen-address={_local(ports.alertmanager)}",
            f"--cluster.listen-address={_local(ports.cluster)}",
        )
        for port in (ports.prometheus, ports.alertmanager):
            self._until_ready(port)

    def _run(self, program: str, *options: str) -> None:
        if shutil.which(program) is None:
            raise MonitoringError(f"{program} is missing: run deploy/dev/setup.sh")
        with (self._folder / f"{program}.log").open("wb") as log:
            self._processes.append(subprocess.Popen([program, *options], cwd=self._folder, stdout=log, stderr=log))

    def _until_ready(self, port: int) -> None:
        give_up_at = time.monotonic() + PATIENCE_S
        while True:
            try:
                with urlopen(f"http://{_local(port)}/-/ready", timeout=PATIENCE_S):
                    return
            except URLError as error:
                if time.monotonic() > give_up_at:
                    raise MonitoringError(f"{error}: see the logs in {self._folder}") from error
                time.sleep(0.1)

    def close(self) -> None:
        """End both."""
        for process in self._processes:
            process.terminate()
        for process in self._processes:
            process.wait()
        self._receiver.shutdown()
        self._receiver.server_close()

    def value(self, query: str) -> float:
        """Return the sum of a query's results; 0 if there are none."""
        found = self._ask(f"query?query={quote(query)}")["result"]
        return sum(float(sample["value"][1]) for sample in found)

    def firing(self) -> Counter[str]:
        """Return how many alerts of each name are firing or pending in Prometheus."""
        return Counter(alert["labels"]["alertname"] for alert in self._ask("alerts")["alerts"])

    def series(self) -> int:
        """Return the number of series in Prometheus' head block."""
        return int(self._ask("status/tsdb")["headStats"]["numSeries"])

    def _ask(self, path: str) -> Any:
        with urlopen(f"http://{_local(self._ports.prometheus)}/api/v1/{path}", timeout=PATIENCE_S) as answer:
            return json.loads(answer.read())["data"]


def _local(port: int) -> str:
    return f"127.0.0.1:{port}"


def _faster(duration: str, pace: float) -> str:
    seconds = sum(int(number) * _UNITS_S[unit] for number, unit in re.findall(r"(\d+)([smh])", duration))
    return f"{max(1, round(1000 * seconds / pace))}ms"


def _text(labels: dict[str, str]) -> str:
    return f"{labels['alertname']}{{{', '.join(_told(labels))}}}"


def _told(labels: dict[str, str]) -> Iterator[str]:
    yield from (f"{key}={value}" for key, value in sorted(labels.items()) if key not in ("alertname", "severity"))
