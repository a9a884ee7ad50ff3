"""Run a program under the restrictions of a systemd unit that can be had without systemd.

unit_sandbox.py UNIT PROGRAM [ARGUMENT...]

System call filter, address families, NoNewPrivileges, MemoryDenyWriteExecute and UMask, read from the unit. The user
and its capabilities are the caller's to set.
"""

from __future__ import annotations

import ctypes
import os
import re
import socket
import subprocess
import sys
from pathlib import Path

_PR_SET_NO_NEW_PRIVS = 38
_PR_SET_MDWE = 65
_PR_MDWE_REFUSE_EXEC_GAIN = 1
_ALLOW = 0x7FFF0000
_ERRNO = 0x00050000
_EPERM = 1
_COMPARE_EQUAL = 4
_UNKNOWN_SYSCALL = -1


class _Compare(ctypes.Structure):
    """struct scmp_arg_cmp of libseccomp."""

    _fields_ = (
        ("argument", ctypes.c_uint),
        ("operation", ctypes.c_int),
        ("first", ctypes.c_uint64),
        ("second", ctypes.c_uint64),
    )


def allowed_calls(unit: str) -> set[str]:
    """Names of the system calls that the unit's filter lets through."""
    allowed = _expand("@default")
    for line in re.findall(r"^SystemCallFilter=(.*)$", unit, re.MULTILINE):
        names = set().union(*(_expand(name) for name in line.removeprefix("~").split()))
        allowed = allowed - names if line.startswith("~") else allowed | names
    return allowed


def _expand(name: str) -> set[str]:
    if not name.startswith("@"):
        return {name}
    listing = subprocess.run(
        ["systemd-analyze", "syscall-filter", "--no-pager", name], capture_output=True, text=True, check=True
    )
    members = (line.strip() for line in listing.stdout.splitlines()[1:])
    return set().union(*(_expand(member) for member in members if member and not member.startswith("#")))


def restrict(unit: str) -> None:
    """Put the restrictions on this process and all it becomes."""
    mask = re.search(r"^UMask=(\d+)$", unit, re.MULTILINE)
    families = re.search(r"^RestrictAddressFamilies=(.*)$", unit, re.MULTILINE)
    assert mask
    assert families
    os.umask(int(mask[1], 8))
    calls = allowed_calls(unit)
    libc = ctypes.CDLL(None, use_errno=True)
    for option, value in ((_PR_SET_NO_NEW_PRIVS, 1), (_PR_SET_MDWE, _PR_MDWE_REFUSE_EXEC_GAIN)):
        if libc.prctl(option, value, 0, 0, 0) != 0 and option != _PR_SET_MDWE:  # MDWE: Linux 6.3
            raise OSError(ctypes.get_errno(), f"prctl {option}")
    seccomp = ctypes.CDLL("libseccomp.so.2")
    seccomp.seccomp_init.restype = ctypes.c_void_p
    rules = ctypes.c_void_p(seccomp.seccomp_init(_ERRNO | _EPERM))
    for call in calls - {"socket"}:
        number = seccomp.seccomp_syscall_resolve_name(call.encode())
        if number != _UNKNOWN_SYSCALL:
            # A call that this architecture does not have is refused here, and nobody can make it.
            seccomp.seccomp_rule_add_array(rules, _ALLOW, number, 0, None)
    number = seccomp.seccomp_syscall_resolve_name(b"socket")
    for family in families[1].split():
        compare = _Compare(0, _COMPARE_EQUAL, int(getattr(socket, family)), 0)
        assert seccomp.seccomp_rule_add_array(rules, _ALLOW, number, 1, ctypes.byref(compare)) == 0
    assert seccomp.seccomp_load(rules) == 0


if __name__ == "__main__":
    restrict(Path(sys.argv[1]).read_text())
    os.execvp(sys.argv[2], sys.argv[2:])
