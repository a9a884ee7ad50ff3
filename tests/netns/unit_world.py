"""Both programs under the restrictions of their units, in a network namespace of their own.

unit_world.py FOLDER [SECONDS]: prints as JSON what systemd and Prometheus would have seen of each. Needs root, and a
network namespace that nobody else uses.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path
from typing import TYPE_CHECKING, Any

from plr.controlplane.ca import Authority
from plr.controlplane.ca.files import write_tls_files
from plr.protos.trust.identity import IdentityRole

if TYPE_CHECKING:
    from collections.abc import Callable

ROOT = Path(__file__).parents[2]
DEPLOY = ROOT / "deploy"
SANDBOX = Path(__file__).with_name("unit_sandbox.py")
READY_S = 60.0
CONNECTED_S = 30.0
STOP_S = 20.0

# Reading all, so that an interpreter in a private home can be run; writing stays the users' own.
READ = "+dac_read_search"
PROGRAMS = {
    "controlplane": (60003, READ, "127.0.0.1:9465"),
    "sidecar": (60002, f"{READ},+net_raw", "127.0.0.1:9464"),
}

WORKING = (
    "plr_control_plane_connected",
    'plr_connected_sidecars{role="robot"}',
    'plr_datagrams_total{direction="received",interface="wlan0",kind="stun"}',
    'plr_stun_datagrams_total{outcome="answered"}',
)
"""Metrics that are not 0 once the two have found each other and STUN has been answered."""

NODES = {"controlplane": IdentityRole.CONTROL_PLANE, "sidecar": IdentityRole.ROBOT}
FIRST_DAYS = 30.0
RENEWED_DAYS = 60.0
EXPIRY = "plr_certificate_expiry_timestamp_seconds"
SECONDS_PER_DAY = 86_400.0


def make_network() -> None:
    for command in (
        "ip link set lo up",
        "ip link add wlan0 type veth peer name far0",
        "ip address add 10.77.0.1/24 dev wlan0",
        "ip link set wlan0 up",
        "ip link set far0 up",
    ):
        subprocess.run(command.split(), check=True)


def write_configurations(folder: Path) -> None:
    (folder / "controlplane.json").write_text(
        json.dumps(
            {
                "tls_dir": str(folder / "controlplane-tls"),
                "listen": "10.77.0.1:50051",
                "stun_listen": "[::]:3478",
                "stun_servers": ["10.77.0.1:3478"],
                "metrics_listen": PROGRAMS["controlplane"][2],
            }
        )
    )
    (folder / "sidecar.json").write_text(
        json.dumps(
            {
                "tls_dir": str(folder / "sidecar-tls"),
                "control_plane": "10.77.0.1:50051",
                "services": [{"name": "/plan_path", "deadline_ms": 100}],
                "interfaces": ["wlan0"],
                "state_dir": str(folder / "state"),
                "metrics_listen": PROGRAMS["sidecar"][2],
            }
        )
    )
    (folder / "state").mkdir()
    os.chown(folder / "state", PROGRAMS["sidecar"][0], PROGRAMS["sidecar"][0])


def issue_certificates(folder: Path) -> Authority:
    """Give each program a tls_dir that belongs to its user."""
    authority = Authority.create()
    for name, role in NODES.items():
        tls = folder / f"{name}-tls"
        tls.mkdir(mode=0o700)
        os.chown(tls, PROGRAMS[name][0], PROGRAMS[name][0])
        authority.write_tls_dir(tls, f"{name}-7", role, days=FIRST_DAYS)
    return authority


def renew_certificates(folder: Path, authority: Authority) -> None:
    for name in NODES:
        renewed = authority.renew(f"{name}-7", days=RENEWED_DAYS)
        write_tls_files(folder / f"{name}-tls", renewed, authority.ca_pem, authority.crl_pem())


def start(name: str, folder: Path) -> tuple[subprocess.Popen[bytes], socket.socket]:
    user, capabilities, _ = PROGRAMS[name]
    notify = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    notify.bind(str(folder / f"{name}.notify"))
    (folder / f"{name}.notify").chmod(0o666)
    environment = {
        "PATH": os.environ["PATH"],
        "NOTIFY_SOCKET": str(folder / f"{name}.notify"),
        "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
        "FASTRTPS_DEFAULT_PROFILES_FILE": str(DEPLOY / "config" / "fastdds.xml"),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "SYSTEM_DEFAULT",
        "ROS_LOG_DIR": str(folder / "state"),
    }
    with (folder / f"{name}.log").open("wb") as log:
        process = subprocess.Popen(
            [
                "setpriv",
                *(f"--reuid={user}", f"--regid={user}", "--clear-groups"),
                *(f"--{kind}-caps=-all,{capabilities}" for kind in ("inh", "ambient")),
                f"--bounding-set=-all,{capabilities}",
                *(sys.executable, SANDBOX, DEPLOY / "systemd" / f"plr-{name}.service"),
                *(sys.executable, "-m", f"plr.{name}", "--config", folder / f"{name}.json"),
            ],
            env=environment,
            cwd=ROOT,
            stdout=log,
            stderr=log,
        )
    return process, notify


def wait_for(notify: socket.socket, word: str, patience_s: float) -> bool:
    end = time.monotonic() + patience_s
    while (left := end - time.monotonic()) > 0:
        notify.settimeout(left)
        with contextlib.suppress(TimeoutError):
            if notify.recv(1024).decode() == word:
                return True
    return False


def metrics(name: str) -> dict[str, float]:
    with urllib.request.urlopen(f"http://{PROGRAMS[name][2]}/metrics", timeout=10) as answer:
        lines = answer.read().decode().splitlines()
    return {key: float(value) for key, _, value in (line.rpartition(" ") for line in lines if not line.startswith("#"))}


def wait_for_metrics(seen: dict[str, Any], condition: Callable[[], bool]) -> None:
    """Put both programs' metrics in until the condition holds, but not for ever: what is amiss shows in them."""
    patience = time.monotonic() + CONNECTED_S
    while True:
        for name in PROGRAMS:
            seen[name]["metrics"] = metrics(name)
        if condition() or time.monotonic() >= patience:
            return
        time.sleep(0.2)


def works(seen: dict[str, Any]) -> bool:
    measured = seen["controlplane"]["metrics"] | seen["sidecar"]["metrics"]
    return all(measured.get(name) for name in WORKING)


def renewal_taken_up(seen: dict[str, Any]) -> bool:
    return all(days_left(seen[name]["metrics"]) > FIRST_DAYS for name in PROGRAMS)


def days_left(metrics: dict[str, float]) -> float:
    """Of the certificate in use."""
    return (metrics.get(EXPIRY, 0.0) - time.time()) / SECONDS_PER_DAY


def main(folder: Path) -> dict[str, Any]:
    make_network()
    write_configurations(folder)
    authority = issue_certificates(folder)
    running: dict[str, tuple[subprocess.Popen[bytes], socket.socket]] = {}
    seen: dict[str, Any] = {}
    try:
        for name in PROGRAMS:
            running[name] = start(name, folder)
            seen[name] = {"ready": wait_for(running[name][1], "READY=1", READY_S), "metrics": {}}
        if all(program["ready"] for program in seen.values()):
            wait_for_metrics(seen, lambda: works(seen))
            renew_certificates(folder, authority)
            # The sidecar connects again with the renewed one: until then it is not connected for a moment.
            wait_for_metrics(seen, lambda: works(seen) and renewal_taken_up(seen))
        for name in reversed(PROGRAMS):
            process, notify = running[name]
            process.send_signal(signal.SIGTERM)
            seen[name]["stopping"] = wait_for(notify, "STOPPING=1", STOP_S)
            seen[name]["exit"] = process.wait(STOP_S)
    finally:
        for name, (process, notify) in running.items():
            process.kill()
            process.wait()
            notify.close()
            seen[name]["log"] = (folder / f"{name}.log").read_text(errors="replace")
    return seen


if __name__ == "__main__":
    sys.stdout.write(json.dumps(main(Path(sys.argv[1]))) + "\n")
