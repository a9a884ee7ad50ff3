"""What outlives full collections is set aside, and found again when it is asked for."""

from __future__ import annotations

import subprocess
import sys

import pytest

PROGRAM = """
import gc, weakref
from protos import interpreter

class Node:
    pass

def ring():
    one, other = Node(), Node()
    one.other, other.other = other, one
    return one

gc.disable()
interpreter.keep_settling()
held = [ring() for _ in range(1000)]
gc.collect()
frozen = gc.get_freeze_count()
assert frozen >= 2000, frozen
seen = [weakref.ref(one) for one in held]
alone = [Node() for _ in range(1000)]
gc.collect()
gone = weakref.ref(alone[0])
alone.clear()
assert gone() is None, "what is no cycle goes without any collection"
held.clear()
gc.collect()
assert all(ref() is not None for ref in seen), "a collection does not look at what is set aside"
interpreter.look_at_all()
gc.collect()
assert not any(ref() is not None for ref in seen)
interpreter.clear()
assert gc.get_freeze_count() == 0
"""


@pytest.mark.audit("ops-19")
def test_what_outlives_full_collections_is_not_looked_at_until_all_is() -> None:
    """In a program of its own: the garbage collector is everybody's."""
    subprocess.run([sys.executable, "-c", PROGRAM], check=True, timeout=60)
