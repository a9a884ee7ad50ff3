"""Ends our programs cleanly when they are not at fault: on Ctrl-C, with no reader of their output, on a full disk."""

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

from plr.protos.program.exit_codes import EXIT_FAILED, EXIT_INTERRUPTED, EXIT_NO_READER

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

P = ParamSpec("P")

_STDERR = 2
_NO_ROOM = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO})


def ends_quietly(name: str) -> Callable[[Callable[P, int]], Callable[P, int]]:
    """Decorate a program's main function, which returns its exit code; `name` begins an error line."""

    def decorate(main: Callable[P, int]) -> Callable[P, int]:
        @functools.wraps(main)
        def run(*args: P.args, **kwargs: P.kwargs) -> int:
            _have_streams()
            try:
                try:
                    _answer_ctrl_c()
                    return main(*args, **kwargs)
                finally:
                    # Flush here, where errors can be handled: the interpreter's own final flush prints a traceback.
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
                sys.stderr.write(f"{name}: its output cannot be written: {error.strerror}\n")
                return EXIT_FAILED

        return run

    return decorate


@contextlib.contextmanager
def ended_by_ctrl_c() -> Iterator[None]:
    """Let Ctrl-C end the program as it ends a C program, within a block that has nothing to clean up.

    Imports take time, and Python loses or prints an exception raised within one.
    """
    ours = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGINT, signal.SIG_DFL) if ours else None
    try:
        yield
    finally:
        if ours:
            signal.signal(signal.SIGINT, before)


def _answer_ctrl_c() -> None:
    """Make Ctrl-C an exception again, so that running code can clean up (see `entry`)."""
    if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGINT) is signal.SIG_DFL:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _have_streams() -> None:
    """Open the standard streams if a shell started us without them (>&-).

    Otherwise the output of C libraries to descriptor 2 would go to the first file or socket that gets the number.
    """
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= _STDERR:
        os.set_inheritable(descriptor, True)
    os.close(descriptor)
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))
        stream = getattr(sys, name)
        if isinstance(stream, io.TextIOWrapper):
            # A locale without the character must not end the program: an escape replaces it.
            stream.reconfigure(errors="backslashreplace")


def print_no_more() -> None:
    """Discard output that can no longer be written, by us or by the interpreter at its end."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
            continue
        with contextlib.suppress(OSError, ValueError):  # a test's stream has no descriptor
            os.dup2(nowhere, stream.fileno())
    os.close(nowhere)
