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

FEWER_YOUNG_OBJECTS, FULL_COLLECTIONS = 5_000, 1
"""The same for a program that sets aside what outlives full collections: each looks at 40,000 objects at most, where
Python's 10 let 400,000 gather. So none holds the interpreter for long."""

OLDEST = 2
"""The generation of a full collection."""


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


def keep_settling() -> None:
    """Set aside also what outlives later full collections, each time, for programs that hold more and more.

    With 1,000 sidecars a full collection of a control plane's objects takes 100 ms. This way it looks only at what came
    since the last one. What is set aside goes when nothing refers to it any more, but not if it is part of a cycle: for
    these there is `look_at_all`.
    """
    gc.callbacks.append(_freeze_what_outlives)
    gc.set_threshold(FEWER_YOUNG_OBJECTS, MIDDLE_COLLECTIONS, FULL_COLLECTIONS)


def look_at_all() -> None:
    """Let the next full collection look at everything that was set aside: much may have ended in cycles since."""
    gc.unfreeze()


def _freeze_what_outlives(phase: str, info: dict[str, int]) -> None:
    if phase == "stop" and info["generation"] == OLDEST:
        gc.freeze()


def clear() -> None:
    """Take everything apart before the end: gRPC waits at exit, for 2 s, until its channels' cycles are gone."""
    if _freeze_what_outlives in gc.callbacks:
        gc.callbacks.remove(_freeze_what_outlives)
    gc.unfreeze()
    gc.collect()
