"""Tunes how a program's threads share the interpreter: while one thread holds it, all others wait."""

from __future__ import annotations

import gc
import sys

SWITCH_INTERVAL_S = 0.0005
"""A computing thread gives up the interpreter after this time (CPython's default is 5 ms). Another interface waits this
long, or a stream while the control plane solves."""

YOUNG_OBJECTS = 10_000
"""Live new objects that trigger a collection of the youngest generation. The cores leave no cycles behind, so a
collection finds next to nothing. With Python's default of 700, one request in eighteen (50 a second) waited for one,
and a fleet's reports took the control plane a tenth longer on average, and now and then much longer."""


MIDDLE_COLLECTIONS = 3
"""Collections of the youngest generation after which the middle one is collected too: 40,000 objects, which hold the
interpreter for 7 ms. With Python's default of 10 it was 19 ms while a large fleet registered."""


def share() -> None:
    """Keep any thread from computing for long while others wait."""
    sys.setswitchinterval(SWITCH_INTERVAL_S)


def settle() -> None:
    """Freeze the objects made during start-up; call this once when start-up is over.

    They stay alive, and a full collection of them would hold the interpreter for 20 to 35 ms. Once frozen they are not
    examined again; later collections see only the requests in flight.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(YOUNG_OBJECTS, MIDDLE_COLLECTIONS, gc.get_threshold()[2])


def collect_by_hand() -> None:
    """Leave collection to `set_aside` and `look_at_all` from now on, in programs that hold more and more objects.

    Python collects when some thousands more objects were created than freed. A fleet's reports replace old objects by
    new ones, which does not count: 90,000 had gathered when Python collected, and held the interpreter for 95 ms.
    """
    gc.disable()


def set_aside() -> None:
    """Collect cycles among the objects made since the last call, and freeze the live ones.

    It takes a microsecond for some ten objects. A frozen object is freed when nothing refers to it any more, unless it
    is part of a cycle: for these there is `look_at_all`. Both do nothing in a program with automatic collection.
    """
    if not gc.isenabled():
        gc.collect(0)
        gc.freeze()


def look_at_all() -> None:
    """Collect frozen objects too, as many may have ended in cycles since; this takes 0.1 s and more."""
    if not gc.isenabled():
        gc.unfreeze()
        gc.collect()
        gc.freeze()


def clear() -> None:
    """Collect everything before the end: at exit, gRPC waits up to 2 s until its channels' cycles are gone."""
    gc.enable()
    gc.unfreeze()
    gc.collect()
