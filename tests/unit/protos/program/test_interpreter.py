"""What lives is set aside, and looked at again when it is asked for."""

from __future__ import annotations

import subprocess
import sys

import pytest

PROGRAM = """
import gc, weakref
from plr.protos.program import interpreter

class Node:
    pass

def ring():
    one, other = Node(), Node()
    one.other, other.other = other, one
    return one

interpreter.settle()
interpreter.collect_by_hand()
seen = [weakref.ref(ring()) for _ in range(100_000)]
assert all(ref() is not None for ref in seen), "nothing is collected unasked"
interpreter.set_aside()
assert not any(ref() is not None for ref in seen), "cycles that have come and gone since are found"
held = [ring() for _ in range(1000)]
frozen = gc.get_freeze_count()
interpreter.set_aside()
assert gc.get_freeze_count() >= frozen + 2000
seen = [weakref.ref(one) for one in held]
alone = [Node() for _ in range(1000)]
interpreter.set_aside()
gone = weakref.ref(alone[0])
alone.clear()
assert gone() is None, "what is no cycle goes without any collection"
held.clear()
interpreter.set_aside()
assert all(ref() is not None for ref in seen), "what was set aside is not looked at"
interpreter.look_at_all()
assert not any(ref() is not None for ref in seen)
interpreter.clear()
assert gc.get_freeze_count() < frozen and gc.isenabled(), "3.12 keeps immortal ones aside itself"
"""


@pytest.mark.audit("ops-19")
def test_what_is_set_aside_is_not_looked_at_until_all_is() -> None:
    """In a program of its own: the garbage collector is everybody's."""
    subprocess.run([sys.executable, "-c", PROGRAM], check=True, timeout=60)
