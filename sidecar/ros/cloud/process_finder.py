"""Finds the process of this host that serves a DDS endpoint, so that its end can be watched.

A DDS id holds 16 bits of a process id, in a namespace that may be another container's. So a process is accepted only if
it takes part in this ROS domain with Fast DDS: it holds the lock of a shared-memory port of the domain, or one of the
domain's UDP ports. The locks are visible for every user's processes, the ports only for processes whose files may be
read.
"""

from __future__ import annotations

import contextlib
import os
import re
import select
from pathlib import Path

from plr.sidecar.ros.cloud.dds_id import pid_bits

PORT_BASE = 7400
PORTS_PER_DOMAIN = 250
"""RTPS: the ports of domain d begin at 7400 + 250 d."""
_PID_BITS = 16
_SHARED_MEMORY = Path("/dev/shm")  # noqa: S108 - where Fast DDS has its ports; nothing is written there
_PORT_LOCK = re.compile(r"fast(?:rtps|dds)_port(\d+)_el")
_RUNNABLE = "R"
_STOPPED = frozenset({"T", "t"})
"""States of a process stopped by a signal or by a debugger (proc(5), stat)."""
_UDP_TABLES = ("/proc/net/udp", "/proc/net/udp6")


def open_process(endpoint: bytes, domain: int) -> int | None:
    """Return a pidfd of the live process behind `endpoint`, or None where it cannot be identified for certain."""
    bits = pid_bits(endpoint)
    if bits is None or not _sees_its_own_namespace():
        return None
    found = [pid for pid in _candidates(bits) if _takes_part(pid, domain)]
    if len(found) != 1 or found[0] == os.getpid():
        return None
    try:
        pidfd = os.pidfd_open(found[0])
    except OSError:
        return None
    # Check once more: if the pidfd's process still lives, it has held the process id all along.
    if _takes_part(found[0], domain) and not has_ended(pidfd):
        return pidfd
    os.close(pidfd)
    return None


def has_ended(pidfd: int) -> bool:
    """Return True when the process has ended."""
    poll = select.poll()
    poll.register(pidfd, select.POLLIN)
    return bool(poll.poll(0))


def wants_processor(pidfd: int) -> bool:
    """Return True when a thread of the process runs or waits for a processor; a stopped or frozen one does not."""
    with contextlib.suppress(OSError, ValueError, StopIteration):
        lines = Path(f"/proc/self/fdinfo/{pidfd}").read_text().splitlines()
        pid = int(next(line for line in lines if line.startswith("Pid:")).split()[1])
        if _state(Path(f"/proc/{pid}/stat")) in _STOPPED:
            return False  # so are all its threads, of which there may be very many
        return any(_state(thread / "stat") == _RUNNABLE for thread in Path(f"/proc/{pid}/task").iterdir())
    return False


def _state(stat: Path) -> str:
    try:
        return stat.read_text().rpartition(")")[2].split()[0]
    except (OSError, IndexError):
        return ""  # it ended


def _sees_its_own_namespace() -> bool:
    """Return whether the process ids in /proc are those of our own namespace, which system calls take."""
    try:
        return int(os.readlink("/proc/self")) == os.getpid()
    except (OSError, ValueError):
        return False


def _candidates(bits: int) -> range:
    try:
        pid_max = int(Path("/proc/sys/kernel/pid_max").read_text())
    except (OSError, ValueError):
        pid_max = 1 << _PID_BITS
    return range(bits or 1 << _PID_BITS, pid_max + 1, 1 << _PID_BITS)


def _takes_part(pid: int, domain: int) -> bool:
    ports = range(PORT_BASE + PORTS_PER_DOMAIN * domain, PORT_BASE + PORTS_PER_DOMAIN * (domain + 1))
    return _holds_port_lock(pid, ports) or _holds_socket(pid, ports)


def _holds_port_lock(pid: int, ports: range) -> bool:
    with contextlib.suppress(OSError):
        held = {
            int(fields[5].rpartition(":")[2])
            for line in Path("/proc/locks").read_text().splitlines()
            if len(fields := line.split()) >= 6 and fields[1] == "FLOCK" and fields[4] == str(pid)
        }
        if held:
            with os.scandir(_SHARED_MEMORY) as files:
                return any(
                    file.inode() in held
                    for file in files
                    if (match := _PORT_LOCK.fullmatch(file.name)) and int(match[1]) in ports
                )
    return False


def _holds_socket(pid: int, ports: range) -> bool:
    wanted = set()
    with contextlib.suppress(OSError):
        for table in _UDP_TABLES:
            for line in Path(table).read_text().splitlines()[1:]:
                fields = line.split()
                if int(fields[1].rpartition(":")[2], 16) in ports:
                    wanted.add(f"socket:[{fields[9]}]")
    with contextlib.suppress(OSError), os.scandir(f"/proc/{pid}/fd") as files:
        for file in files:
            with contextlib.suppress(OSError):
                if os.readlink(file.path) in wanted:
                    return True
    return False
