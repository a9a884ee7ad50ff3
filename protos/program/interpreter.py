"""How a program's threads share the interpreter: who holds it, and for how long, is what all others wait for."""

from __future__ import annotations

import gc
import sys

SWITCH_INTERVAL_S = 0.0005
"""A computing thread gives the interpreter up after this (CPython's default is 5 ms): what another interface waits, or
a stream while the control plane solves."""

YOUNG_OBJECTS = 10_000
"""New objects alive that make a collection of the youngest worth while. The cores leave no cycles behind, so a
collection finds next to nothing; with Python's 700, one request in eighteen (50 a second) waited for one, and reports
of a fleet took the control plane a tenth longer on average, and now and then much longer."""


MIDDLE_COLLECTIONS = 3
"""Collections of the youngest after which the middle-aged are looked at too: 40,000 objects, which hold the interpreter
for 7 ms. With Python's 10 it was 19 ms while a large fleet registered."""


def share() -> None:
    """Let no thread compute for long while others wait."""
    sys.setswitchinterval(SWITCH_INTERVAL_S)


def settle() -> None:
    """Call it once, when start-up is over.

    What start-up made stays: a full collection over it would hold the interpreter for 20 to 35 ms. Set aside, it is
    not looked at again; later collections see the requests in flight only.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(YOUNG_OBJECTS, MIDDLE_COLLECTIONS, gc.get_threshold()[2])


def collect_by_hand() -> None:
    """From now on nothing is collected but by `set_aside` and `look_at_all`, for programs that hold more and more.

    Python looks when some thousands more objects were made than went. A fleet's reports put new objects in the place of
    old ones, which counts as nothing: 90,000 had gathered when Python looked, and held the interpreter for 95 ms.
    """
    gc.disable()


def set_aside() -> None:
    """Look at what was made since the last call, for cycles, and set aside what lives.

    It takes a microsecond for some ten objects. What is set aside goes when nothing refers to it any more, but not if
    it is part of a cycle: for these there is `look_at_all`. Both do nothing in a program that collects by itself.
    """
    if not gc.isenabled():
        gc.collect(0)
        gc.freeze()


def look_at_all() -> None:
    """Look at everything that was set aside too: much may have ended in cycles since. 0.1 s and more."""
    if not gc.isenabled():
        gc.unfreeze()
        gc.collect()
        gc.freeze()


def clear() -> None:
    """Take everything apart before the end: gRPC waits at exit, for 2 s, until its channels' cycles are gone."""
    gc.enable()
    gc.unfreeze()
    gc.collect()
