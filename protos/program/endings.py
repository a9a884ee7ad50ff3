"""How our programs end where they are not at fault: by Ctrl-C, when nobody reads what they print, at a full disk."""

from __future__ import annotations

import contextlib
import errno
import functools
import io
import os
import signal
import sys
import threading
from typing import TYPE_CHECKING, ParamSpec

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

P = ParamSpec("P")

EXIT_FAILURE = 1
EXIT_NO_READER = 128 + signal.SIGPIPE
"""As the shell tells of a program that SIGPIPE ended, ..."""
EXIT_INTERRUPTED = 128 + signal.SIGINT
"""... or Ctrl-C."""
_STDERR = 2
_NO_ROOM = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO})


def ends_quietly(name: str) -> Callable[[Callable[P, int]], Callable[P, int]]:
    """Decorate a program's main function, which returns its exit code; `name` begins a line of error."""

    def decorate(main: Callable[P, int]) -> Callable[P, int]:
        @functools.wraps(main)
        def run(*args: P.args, **kwargs: P.kwargs) -> int:
            _have_streams()
            try:
                try:
                    _answer_ctrl_c()
                    return main(*args, **kwargs)
                finally:
                    # Here, where it can be answered for: the interpreter's own at its end prints a traceback.
                    sys.stdout.flush()
            except BrokenPipeError:
                print_no_more()
                return EXIT_NO_READER
            except KeyboardInterrupt:
                return EXIT_INTERRUPTED
            except OSError as error:
                if error.errno not in _NO_ROOM or error.filename is not None:
                    raise
                print_no_more()
                sys.stderr.write(f"{name}: what it prints cannot be written: {error.strerror}\n")
                return EXIT_FAILURE

        return run

    return decorate


@contextlib.contextmanager
def ended_by_ctrl_c() -> Iterator[None]:
    """In the block, which has nothing to tidy up, Ctrl-C ends the program as it ends one in C: imports take their time,
    and Python loses an exception, or prints it, that comes within one."""
    ours = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGINT, signal.SIG_DFL) if ours else None
    try:
        yield
    finally:
        if ours:
            signal.signal(signal.SIGINT, before)


def _answer_ctrl_c() -> None:
    """Ctrl-C is an exception again, which whatever is under way may tidy up after (see `entry`)."""
    if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGINT) is signal.SIG_DFL:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _have_streams() -> None:
    """A shell may start us without them (>&-).

    What C libraries print to descriptor 2 would go to the first file or socket that gets the number.
    """
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= _STDERR:
        os.set_inheritable(descriptor, True)
    os.close(descriptor)
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))
        stream = getattr(sys, name)
        if isinstance(stream, io.TextIOWrapper):
            # A locale without the character must not end the program: an escape stands for it.
            stream.reconfigure(errors="backslashreplace")


def print_no_more() -> None:
    """Let go what is still to be written and cannot be, by us and by the interpreter at its end."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
            continue
        with contextlib.suppress(OSError, ValueError):  # a test's has no number
            os.dup2(nowhere, stream.fileno())
    os.close(nowhere)
