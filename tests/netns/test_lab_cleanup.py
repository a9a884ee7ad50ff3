"""Whatever ends the process that made the lab: no process, namespace, interface or rule is left."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.netns.lab_traffic import PATIENCE_S

if TYPE_CHECKING:
    from collections.abc import Iterator

pytestmark = pytest.mark.netns
REPOSITORY = Path(__file__).resolve().parents[2]
NOBODY = 65534

# Makes a lab with a few programs, one deaf to signals, one stopped, one with a child, and tells who they are.
OWNER = """
import json, signal, sys, time
from lab import Lab, LinkProfile
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it
with Lab(seed=1) as lab:
    robot = lab.host("robot")
    lab.link("wlan0").set(LinkProfile(delay_ms=5))
    stopped = robot.popen(["sleep", "1000"])
    stopped.send_signal(signal.SIGSTOP)
    programs = [
        stopped,
        robot.popen(["sh", "-c", "trap '' INT TERM HUP; while :; do sleep 1; done"]),
        lab.host("cloud_a").popen(["sh", "-c", "sleep 1000 & sleep 1000"]),
    ]
    ping = robot.run(["ping", "-n", "-c1", "-W2", "-I", "wlan0", lab.host("cloud_a").address()])
    print(json.dumps({
        "anchors": [host.anchor_pid for host in lab.hosts.values()],
        "programs": [program.inner_pid for program in programs],
        "nsenters": [program.pid for program in programs],
        "holder": lab._holder.pid,
        "port_kind": lab.port_kind,
        "reached": ping.returncode == 0,
    }), flush=True)
    HOW
"""
ENDS = {
    "killed": "time.sleep(1000)",
    "interrupted": "time.sleep(1000)",
    "terminated": "time.sleep(1000)",
    "exception": "1 / 0",
    "exit without close": "import os; os._exit(5)",
    "regular": "pass",
}
SIGNALS = {"killed": signal.SIGKILL, "interrupted": signal.SIGINT, "terminated": signal.SIGTERM}


# Names of the lab's interfaces, machines and tables. Other programs may change the machine's network
# while a test runs; only what bears such a name is the lab's.
MARKS = re.compile(r"\b(wlan0|wwan0|lan0|wan0|to\d+|l\d+[io]|robot|cloud_[ab]|firewall|translation)\b")


def traces_of_a_lab() -> Counter[str]:
    """What the machine's own namespace shows of a lab: interfaces, named namespaces, rules."""
    lines: list[str] = []
    for command in ("ip -o link", "ip netns", "nft list ruleset"):
        lines += subprocess.run(command.split(), capture_output=True, text=True, check=False).stdout.splitlines()
    return Counter(line for line in lines if MARKS.search(line))


def namespace_ids(pid: int) -> set[str]:
    return {os.readlink(f"/proc/{pid}/ns/{kind}") for kind in ("net", "mnt", "pid", "uts", "ipc")}


def processes_in(namespaces: set[str]) -> list[int]:
    """Every process of the machine that is in one of these namespaces."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                if namespace_ids(int(entry.name)) & namespaces:
                    found.append(int(entry.name))
            except (FileNotFoundError, ProcessLookupError, PermissionError):
                continue
    return found


def check_that_nothing_is_left(owner: subprocess.Popen[str], how: str) -> None:
    """Let the owner tell about its lab, end it, and look for remains."""
    assert owner.stdout is not None
    line = owner.stdout.readline()
    assert line, "the owner died before its lab was up"
    told = json.loads(line)
    assert told["reached"]
    pids = {*told["anchors"], *told["programs"], *told["nsenters"], told["holder"]}
    namespaces: set[str] = set()
    if how in SIGNALS:  # otherwise it is over already, or about to be
        own = namespace_ids(os.getpid())
        for pid in told["anchors"]:
            namespaces |= namespace_ids(pid) - own
        assert len(namespaces) > 3 * len(told["anchors"])
        assert len(processes_in(namespaces)) >= len(told["anchors"]) + len(told["programs"])
        owner.send_signal(SIGNALS[how])
    owner.wait(PATIENCE_S)
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        left = [pid for pid in pids if Path(f"/proc/{pid}/exe").exists()] + processes_in(namespaces)
        if not left:
            break
        time.sleep(0.01)
    assert not left, f"still there after {how}: {left}"


@pytest.mark.parametrize("how", list(ENDS))
def test_nothing_is_left_however_the_owner_ends(how: str) -> None:
    before = traces_of_a_lab()
    with subprocess.Popen(
        [sys.executable, "-S", "-c", OWNER.replace("HOW", ENDS[how])],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=REPOSITORY,
    ) as owner:
        try:
            check_that_nothing_is_left(owner, how)
        finally:
            owner.kill()
        assert owner.stderr is not None
        errors = owner.stderr.read()
    expected = {"exception": "ZeroDivisionError", "interrupted": "KeyboardInterrupt"}.get(how, "")
    assert expected in errors
    assert "ResourceWarning" not in errors
    assert traces_of_a_lab() == before


@pytest.fixture
def world_readable_copy() -> Iterator[Path]:
    """The lab where anybody may read it; a checkout may lie in a home directory that is closed to others."""
    folder = Path(tempfile.mkdtemp(prefix="lab-test-"))
    for package in ("lab", "controlplane", "protos"):  # it reads traces as `plr plan` does
        shutil.copytree(REPOSITORY / package, folder / package, ignore=shutil.ignore_patterns("__pycache__"))
    (folder / "plr").mkdir()
    for package in ("controlplane", "protos"):
        (folder / "plr" / package).symlink_to(f"../{package}")
    for path in (folder, *folder.rglob("*")):
        path.chmod(0o755 if path.is_dir() else 0o644)
    yield folder
    shutil.rmtree(folder)


AS_NOBODY = ["setpriv", f"--reuid={NOBODY}", f"--regid={NOBODY}", "--clear-groups"]


def python_for_everybody() -> str:
    """A Python that an ordinary user may run; the venv's may lie in root's home directory."""
    probe = ["-c", "import sys; sys.exit(sys.version_info < (3, 11))"]
    for candidate in (sys.executable, "/usr/bin/python3", "/usr/local/bin/python3"):
        try:
            if (
                subprocess.run(
                    [*AS_NOBODY, "env", candidate, "-S", *probe], capture_output=True, check=False
                ).returncode
                == 0
            ):
                return candidate
        except OSError:
            continue
    pytest.skip("no Python >= 3.11 that an ordinary user may run")


@pytest.mark.skipif(os.geteuid() != 0, reason="every other test runs unprivileged already")
@pytest.mark.parametrize(
    "prefix",
    [AS_NOBODY, [*AS_NOBODY, "unshare", "-Ur"], ["unshare", "-Ur"]],
    ids=["user", "user in its namespace", "root in a namespace"],
)
def test_unprivileged_lab_works_and_leaves_nothing(prefix: list[str], world_readable_copy: Path) -> None:
    before = traces_of_a_lab()
    with subprocess.Popen(
        [*prefix, python_for_everybody(), "-S", "-c", OWNER.replace("HOW", ENDS["killed"])],
        stdout=subprocess.PIPE,
        text=True,
        cwd=world_readable_copy,
        env={"PATH": os.environ["PATH"], "PYTHONDONTWRITEBYTECODE": "1"},
    ) as owner:
        try:
            check_that_nothing_is_left(owner, "killed")
        finally:
            owner.kill()
    assert traces_of_a_lab() == before
