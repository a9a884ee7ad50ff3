"""plr bugreport: collect what a helper needs to find a fault on this node, in one tar file, without secrets.

examples:
  plr bugreport                                write plr-bugreport-NAME-TIME.tar.gz in the current folder
  plr bugreport --output /tmp/report.tar.gz
  plr bugreport --config try/robot.yaml

It contains the configuration, what plr doctor finds, versions, the last journal lines, addresses and routes, sysctls,
and the metrics. It never contains keys, certificates, the state folder, or the environment beyond what ROS uses.
(left out) replaces what looks like a secret. It names nodes, addresses and services of your fleet: read it before you
publish it.

exit codes: 0 written, 1 it cannot be written, 2 bad usage
"""

from __future__ import annotations

import io
import json
import os
import platform
import shutil
import socket
import subprocess
import sys
import tarfile
import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING

import yaml

from plr.protos.base.errors import ConfigError
from plr.protos.base.host_port import split_host_port
from plr.protos.base.printable import escaped
from plr.protos.program import commit
from plr.protos.program.config_file import parse_yaml, read_text
from plr.protos.program.exit_codes import EXIT_FAILED, EXIT_OK
from plr.sidecar.config.sidecar import SidecarConfig
from plr.sidecar.doctor.command import as_json, as_text
from plr.sidecar.doctor.examination import examine
from plr.sidecar.doctor.options import parser_of, where_of
from plr.sidecar.doctor.scrub import scrubbed, scrubbed_value

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from plr.sidecar.doctor.examination import Examination, Where

MAX_PART_BYTES = 8 << 20
"""Limit of each file; a longer one loses its middle."""
COMMAND_S = 15.0
METRICS_S = 5.0
JOURNAL_LINES = 2000
PACKAGES = (
    "fogros2-plr", "cryptography", "grpcio", "numpy", "prometheus-client", "protobuf", "pydantic", "pyroute2", "pyyaml",
    "zfec", "ros-jazzy-rclpy",
)  # fmt: skip
COMMANDS = {
    "ip-address.txt": ("ip", "-d", "-s", "address"),
    "ip-route.txt": ("ip", "route", "show", "table", "all"),
    "ip-6-route.txt": ("ip", "-6", "route", "show", "table", "all"),
    "ip-rule.txt": ("ip", "rule"),
    "sockets.txt": ("ss", "-uapnmi"),
    "clock.txt": ("timedatectl", "show"),
    "unit.txt": ("systemctl", "status", "plr-sidecar", "--no-pager", "--lines=0"),
    "journal.txt": (
        "journalctl", "--unit=plr-sidecar", "--no-pager", "--output=short-iso-precise", f"--lines={JOURNAL_LINES}"
    ),
}  # fmt: skip
SYSCTLS = ("net/ipv4/conf/*/rp_filter", "net/ipv4/conf/*/arp_ignore", "net/core/[rw]mem_*", "net/ipv4/ip_forward")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `plr bugreport` and return its exit code."""
    parser = parser_of("plr bugreport", __doc__)
    parser.add_argument(
        "--output", type=Path, metavar="FILE", help="default: plr-bugreport-NAME-TIME.tar.gz in the current folder"
    )
    options = parser.parse_args(arguments)
    where = where_of(options)
    seen = examine(where)
    name = "unknown" if seen.config is None else seen.config.name
    stem = f"plr-bugreport-{name}-{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}"
    output = options.output or Path(f"{stem}.tar.gz")
    try:
        write(output, stem, seen, where)
    except OSError as error:
        sys.stderr.write(escaped(f"plr bugreport: {output} cannot be written: {error.strerror or error}") + "\n")
        return EXIT_FAILED
    sys.stdout.write(escaped(f"{output}: read it before you publish it: tar tzf {output}") + "\n")
    return EXIT_OK


def write(output: Path, stem: str, seen: Examination, where: Where) -> None:
    """Write the tar file, readable by this user only; raises OSError."""
    descriptor = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    try:
        with open(descriptor, "wb") as file, tarfile.open(fileobj=file, mode="w:gz") as tar:
            for name, text in parts(seen, where):
                data = text.encode(errors="replace")
                info = tarfile.TarInfo(f"{stem}/{name}")
                info.size, info.mtime, info.mode = len(data), int(time.time()), 0o600
                tar.addfile(info, io.BytesIO(data))
    except BaseException:
        output.unlink(missing_ok=True)
        raise


def parts(seen: Examination, where: Where) -> Iterator[tuple[str, str]]:
    """Yield name and text of each file, without secrets; an unavailable part says why."""
    yield "doctor.txt", _free(as_text(seen.findings))
    yield "doctor.json", json.dumps(scrubbed_value(json.loads(as_json(seen))), indent=2)
    yield "configuration.yaml", _configuration(where.config, seen.config)
    yield "versions.txt", _free(_versions())
    for name, command in COMMANDS.items():
        yield name, _free(_output(command))
    yield "sysctl.txt", _free(_sysctls())
    yield "metrics.txt", _free(_metrics(seen))


def _free(text: str) -> str:
    """Return free text without secrets, of at most MAX_PART_BYTES and a line."""
    return scrubbed(_shortened(text))


def _shortened(text: str) -> str:
    if len(text) <= MAX_PART_BYTES:
        return text
    half = MAX_PART_BYTES // 2
    return f"{text[:half]}\n... {len(text) - 2 * half} characters left out ...\n{text[-half:]}"


def _configuration(path: Path, config: SidecarConfig | None) -> str:
    """Return the configuration's known keys with their checked values.

    Of a wrong configuration, return the known keys only: anything else in it may be a secret.
    """
    if config is not None:
        return yaml.safe_dump(scrubbed_value(config.model_dump(mode="json", warnings=False)), sort_keys=False)
    try:
        content = parse_yaml(read_text(path), str(path))
    except ConfigError as error:
        return _free(f"{error}\n")
    known = [key for key in content if key in SidecarConfig.model_fields]
    lines = [f"{key}: (left out, because the configuration is invalid)" for key in known]
    return "\n".join([*lines, f"# {len(content) - len(known)} unknown keys", ""])


def _versions() -> str:
    lines = [f"python {platform.python_version()} ({sys.executable})", f"kernel {platform.release()}"]
    lines += [f"machine {platform.machine()}, {os.cpu_count()} processors"]
    try:
        lines += [f"system {platform.freedesktop_os_release().get('PRETTY_NAME', 'unknown')}"]
    except OSError:
        lines += ["system unknown"]
    # On its own line: as part of the version it may be long enough to be taken for a key.
    lines += [f"commit {commit.commit() or 'not known'}"]
    for package in PACKAGES:
        try:
            lines.append(f"{package} {version(package)}")
        except PackageNotFoundError:
            lines.append(f"{package} not installed here")
    return "\n".join(lines) + "\n"


def _output(command: tuple[str, ...]) -> str:
    program = shutil.which(command[0])
    if program is None:
        return f"{command[0]} is not installed\n"
    try:
        done = subprocess.run(  # noqa: S603  (commands of ours, no shell)
            (program, *command[1:]),
            capture_output=True,
            timeout=COMMAND_S,
            check=False,
            env={**os.environ, "LC_ALL": "C"},
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"{' '.join(command)}: {error}\n"
    return done.stdout.decode(errors="replace") + done.stderr.decode(errors="replace")


def _sysctls() -> str:
    root = Path("/proc/sys")
    lines = []
    for pattern in SYSCTLS:
        for path in sorted(root.glob(pattern)):
            try:
                lines.append(f"{path.relative_to(root)} = {path.read_text().strip()}")
            except OSError as error:
                lines.append(f"{path.relative_to(root)}: {error.strerror}")
    return "\n".join(lines) + "\n"


def _metrics(seen: Examination) -> str:
    listen = None if seen.config is None else seen.config.metrics_listen
    if listen is None:
        return "no metrics are served\n"
    try:
        head, _, page = _answer(*split_host_port(listen), time.monotonic() + METRICS_S).partition(b"\r\n\r\n")
    except OSError as error:
        return f"http://{listen}/metrics: {error}\n"
    status = head.partition(b"\r\n")[0]
    return (page if b" 200 " in status else status).decode(errors="replace")


def _answer(host: str, port: int, until: float) -> bytes:
    """Return the answer; raise OSError, also if it has not ended by `until` (monotonic seconds).

    The timeout of an HTTP library is for each single read, and any user may have taken the port of a sidecar that is
    down, to answer a byte at a time.
    """
    data = bytearray()
    with socket.create_connection((host, port), METRICS_S) as sock:
        sock.sendall(f"GET /metrics HTTP/1.0\r\nHost: {host}\r\n\r\n".encode())
        while len(data) < MAX_PART_BYTES and (left := until - time.monotonic()) > 0:
            sock.settimeout(left)
            some = sock.recv(1 << 16)
            if not some:
                return bytes(data)
            data += some
    if len(data) < MAX_PART_BYTES:
        raise TimeoutError("no complete answer in time: another program may have taken the port")
    return bytes(data)
