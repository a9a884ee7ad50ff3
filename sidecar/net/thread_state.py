"""Asks the kernel whether a thread is inside a system call (proc(5), /proc/pid/syscall)."""

from __future__ import annotations

import platform
from pathlib import Path

_LOCK_CALLS: dict[str, frozenset[str]] = {
    "x86_64": frozenset({"202", "449"}),
    "aarch64": frozenset({"98", "449"}),
    "armv7l": frozenset({"240", "422", "449"}),
    "riscv64": frozenset({"98", "449"}),
}
"""futex, futex_time64 and futex_waitv, in which a thread waits for the interpreter or for another lock of ours."""

_HERE = _LOCK_CALLS.get(platform.machine())


def is_in_a_call(thread_id: int | None) -> bool:
    """Return whether this thread of ours waits in the kernel, but for no lock, processor or other thread.

    Return True also where that cannot be found out. `thread_id` is the kernel's (`Thread.native_id`).
    """
    if thread_id is None or _HERE is None:
        return True
    try:
        call = Path(f"/proc/self/task/{thread_id}/syscall").read_text(encoding="ascii").split(" ", 1)[0].strip()
    except OSError:
        return True
    return call != "running" and call not in _HERE
