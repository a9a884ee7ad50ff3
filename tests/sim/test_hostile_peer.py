"""A known peer that floods a cloud costs it bounded memory, and an honest robot beside it loses nothing.

The floods go on until every table that they fill is full; from then on memory must not grow.
"""

from __future__ import annotations

import gc
import itertools
import tracemalloc
from typing import TYPE_CHECKING

import pytest

from plr.sidecar.core.link import sender
from plr.sidecar.core.message import reassembly
from plr.sidecar.core.wire import frame
from plr.sidecar.core.wire.frame import BASE_SYMBOL_BYTES, MAX_MESSAGE_BYTES, MIN_SYMBOL_BYTES
from tests.fuzz.test_engine_fuzz import Rogue, arena, assert_bounded

if TYPE_CHECKING:
    from collections.abc import Callable

    from lab.simulated.mesh import Mesh, Node

CAP = 300
"""What the tables that the floods fill may hold here, instead of thousands."""
FILL = 2_000
"""Frames after which they are full."""
FLOOD = 4_000
"""Frames afterwards, during which memory must not grow."""
TURN = 200
"""Frames between two turns of the others."""
GROWTH_BYTES = 100_000
"""Allowed while the flood goes on, 25 bytes a frame: the honest robot's own, caches of the interpreter."""

counting = itertools.count(1)


def opened(size: int, symbol: int) -> bytes:
    """The first symbol of a message that never comes to its end."""
    return frame.encode_fragment_head(next(counting), size, symbol, 0) + bytes(min(symbol, size))


def tail(size: int, symbol: int) -> bytes:
    """The last, shortest symbol of a message: the least to send for what it announces."""
    last = -(-size // symbol) - 1
    return frame.encode_fragment_head(next(counting), size, symbol, last) + bytes(size - last * symbol)


def opened_and_abandoned() -> bytes:
    body = opened(2 * BASE_SYMBOL_BYTES, BASE_SYMBOL_BYTES)
    return body + frame.encode_abandon(frame.Abandon(next(counting) - 1))


def empty_messages() -> bytes:
    """As many whole messages as a datagram takes; each is answered by FINISHED."""
    return b"".join(frame.encode_fragment_head(next(counting), 0, MIN_SYMBOL_BYTES, 0) for _ in range(frame.MAX_FRAMES))


FLOODS: dict[str, Callable[[], bytes]] = {
    "messages opened and never finished": lambda: opened(2 * BASE_SYMBOL_BYTES, BASE_SYMBOL_BYTES),
    "messages of the smallest symbols": lambda: opened(60_000, MIN_SYMBOL_BYTES),
    "the largest messages": lambda: opened(MAX_MESSAGE_BYTES, BASE_SYMBOL_BYTES),
    "the largest messages, one byte of each": lambda: tail(1 + 1024 * 1000, 1000),
    "messages without content": empty_messages,
    "probes": lambda: frame.encode_probe(frame.Probe(next(counting))) * frame.MAX_FRAMES,
    "padded probes": lambda: frame.encode_probe(frame.Probe(next(counting))) + frame.encode_padding(8000),
    "answers to no probe": lambda: frame.encode_probe_reply(frame.ProbeReply(next(counting))) * frame.MAX_FRAMES,
    "acknowledgements of what was never sent": lambda: frame.encode_ack([(0, 2**62 + next(counting))], 0.0),
    "acknowledgements of all that was sent": lambda: frame.encode_ack([(0, 5)], 0.0),
    "nothing but repair symbols": lambda: frame.encode_fragment_head(next(counting), 40_000, 1000, 40) + bytes(1000),
    "messages abandoned that are none": lambda: b"".join(
        frame.encode_abandon(frame.Abandon(next(counting))) for _ in range(frame.MAX_FRAMES)
    ),
    "messages opened and abandoned": opened_and_abandoned,
    "messages forgotten that are none": lambda: b"".join(
        frame.encode_forgotten(frame.Forgotten(next(counting))) for _ in range(frame.MAX_FRAMES)
    ),
    "messages finished that are none": lambda: b"".join(
        frame.encode_finished(frame.Finished(next(counting))) for _ in range(frame.MAX_FRAMES)
    ),
}


def flood(rogue: Rogue, make: Callable[[], bytes], count: int, honest: Node) -> int:
    """Send so many frames, in turn with the honest robot's requests; returns how many requests those were."""
    requests = 0
    for _ in range(count // TURN):
        frames = 0
        while frames < TURN:
            body = make()
            frames += len(frame.decode_frames(memoryview(body)))
            rogue.send([body])
        rogue.answer_probes()
        honest.submit(b"still here")
        requests += 1
        rogue.mesh.run(0.05)
    return requests


def measured() -> int:
    gc.collect()
    return tracemalloc.get_traced_memory()[0]


@pytest.mark.parametrize("kind", FLOODS)
def test_a_flood_costs_bounded_memory_and_harms_nobody(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sender, "MAX_RUNS_IN_FLIGHT", CAP // frame.MAX_FRAMES)
    for name in ("MAX_PEER_MESSAGES", "OVER_REMEMBERED"):
        monkeypatch.setattr(reassembly, name, CAP)
    mesh, honest, node, cloud = arena(1)
    rogue = Rogue(mesh, node, cloud)
    node.alive = False  # it says nothing but this, hears nothing, acknowledges nothing
    tracemalloc.start()
    try:
        requests = flood(rogue, FLOODS[kind], FILL, honest)
        before = measured()
        requests += flood(rogue, FLOODS[kind], FLOOD, honest)
        growth = measured() - before
    finally:
        tracemalloc.stop()
    assert growth < GROWTH_BYTES, f"grew by {growth} bytes"
    assert_bounded(cloud)
    mesh.run(1.0)
    assert len(honest.responses()) == requests
    assert max(response.elapsed_s for response in honest.responses()) < 0.1
    assert_forgotten(mesh, cloud)


def assert_forgotten(mesh: Mesh, cloud: Node) -> None:
    """Silence: what the peer left behind goes by its age."""
    mesh.run(60.0)
    assert all(reassembler.held_bytes == 0 for reassembler in cloud.engine._inbound._reassemblers.values())
