"""Reassembles messages from symbols that may come over any path of a peer; capped in bytes, count and age.

What is dropped unfinished was acknowledged in part, so what still comes would never complete it. Its number is
remembered, and a further symbol of it is answered FORGOTTEN: the sender sends the message again, under another number.
"""

from __future__ import annotations

import enum
from collections import OrderedDict
from typing import TYPE_CHECKING, NamedTuple

from plr.sidecar.core.base.timers import NEVER
from plr.sidecar.core.message.partial import Partial

if TYPE_CHECKING:
    from collections import Counter
    from collections.abc import Sequence

    from plr.protos.model.ids import NodeName
    from plr.sidecar.core.base.values import PathId
    from plr.sidecar.core.wire.frame import Fragment

MAX_PEER_BYTES = 64 * 1024 * 1024
"""Announced bytes of one peer's unfinished messages: almost four of the largest. A sender keeps below it (`outbox.py`)
unless what it called off is still held here (ABANDON is sent once)."""
MAX_PEER_MESSAGES = 8192
"""Unfinished messages of one peer: as many as requests may be in flight to it."""
MAX_SILENCE_S = 30.0
"""An unfinished message that gets no symbol for this long is dropped."""
OVER_REMEMBERED = 8192
"""Finished, forgotten or abandoned message numbers kept per peer, so that late symbols are recognised."""


class Fate(enum.Enum):
    """What became of a message."""

    FINISHED = "finished"
    FORGOTTEN = "forgotten"
    """Dropped unfinished to make room, or for its age."""
    ABANDONED = "abandoned"
    """Its sender does not send the rest."""


class Reassembled(NamedTuple):
    """What to tell the sender of a message, once for all the symbols added together."""

    number: int
    fate: Fate
    content: memoryview | Partial | None
    """The message, if it was just finished; a Partial still has to be decoded."""
    ends_at: float = NEVER
    """When a message that was just finished stops being of use."""
    paths: Sequence[PathId] = ()
    """The paths by which the symbols of such a message came, if they were several."""


class Reassembler:
    """Unfinished messages of one peer's session."""

    __slots__ = ("_bytes", "_dropped", "_over", "_partials", "peer")

    def __init__(self, peer: NodeName, dropped: Counter[str]) -> None:
        self.peer = peer
        self._partials: OrderedDict[int, Partial] = OrderedDict()
        """Sorted by the last symbol, longest ago first."""
        self._over: OrderedDict[int, Fate] = OrderedDict()
        self._bytes = 0
        self._dropped = dropped

    @property
    def held_bytes(self) -> int:
        """Bytes that the unfinished messages claim."""
        return self._bytes

    def __len__(self) -> int:
        """Return the number of unfinished messages."""
        return len(self._partials)

    def add(self, fragments: list[Fragment], now: float, path: PathId | None = None) -> list[Reassembled]:
        """Store symbols, which came by `path`; return what there is to tell.

        Each symbol is copied once, to its place in the message: nothing that is returned views a datagram.
        """
        out: dict[int, Reassembled] = {}
        partials = self._partials
        current: int | None = None
        partial: Partial | None = None
        for number, total, symbol, index, data, left_us in fragments:
            if number != current or partial is None:
                current = number
                partial = partials.get(number)
                if partial is None:
                    partial = self._meet(number, total, symbol, data, now, left_us, out)
                    if partial is None:
                        continue
                else:
                    partial.touched_at = now
                    partials.move_to_end(number)
                if path is not None and path not in partial.paths:
                    partial.paths.append(path)
            if total != partial.total or symbol != partial.symbol:
                self._dropped["fragment_mismatch"] += 1
                continue
            ends_at = now + left_us * 1e-6
            if ends_at < partial.ends_at:
                partial.ends_at = ends_at
            if index < partial.count:
                have = partial.have
                if have[index]:
                    continue
                have[index] = 1
                start = index * symbol
                partial.buffer[start : start + len(data)] = data
                partial.missing -= 1
                if partial.missing and not partial.repairs:
                    continue
            elif not self._add_repair(partial, index - partial.count, data):
                partial = partials.get(number)
                continue
            if not partial.missing:
                out[number] = self._finish(partial, partial.whole())
                partial = None
            elif partial.is_decodable():
                out[number] = self._finish(partial, partial)
                partial = None
        return list(out.values())

    def _meet(
        self,
        number: int,
        total: int,
        symbol: int,
        data: memoryview,
        now: float,
        left_us: int,
        out: dict[int, Reassembled],
    ) -> Partial | None:
        """Handle a symbol of a message without a Partial; return the Partial to store it in, if any."""
        fate = self._over.get(number)
        if fate is not None:
            if fate is not Fate.ABANDONED:
                out.setdefault(number, Reassembled(number, fate, None))
            return None
        if total <= symbol:
            # The repair symbol of a lone symbol is its padded copy.
            self._remember(number, Fate.FINISHED)
            # A copy, since the datagram's buffer is reused.
            whole, ends_at = memoryview(bytes(data[:total])), now + left_us * 1e-6
            out[number] = Reassembled(number, Fate.FINISHED, whole, ends_at)
            return None
        self._make_room(total, messages=1)
        partial = self._partials[number] = Partial(number, total, symbol, now)
        self._bytes += total
        return partial

    def _add_repair(self, partial: Partial, repair: int, data: memoryview) -> bool:
        if not partial.wants_repair(repair):
            return False
        self._make_room(partial.symbol, messages=0)
        if partial.number not in self._partials:
            return False
        partial.add_repair(repair, data)
        self._bytes += partial.symbol
        return True

    def _finish(self, partial: Partial, content: memoryview | Partial) -> Reassembled:
        self._remove(partial)
        self._remember(partial.number, Fate.FINISHED)
        return Reassembled(partial.number, Fate.FINISHED, content, partial.ends_at, partial.paths)

    def _make_room(self, size: int, messages: int) -> None:
        partials = self._partials
        while partials and (len(partials) + messages > MAX_PEER_MESSAGES or self._bytes + size > MAX_PEER_BYTES):
            self._forget_oldest("reassembly_evicted")

    def _forget_oldest(self, reason: str) -> None:
        partial = next(iter(self._partials.values()))
        self._remove(partial)
        self._remember(partial.number, Fate.FORGOTTEN)
        self._dropped[reason] += 1

    def _remove(self, partial: Partial) -> None:
        del self._partials[partial.number]
        self._bytes -= partial.held_bytes

    def _remember(self, number: int, fate: Fate) -> None:
        self._over[number] = fate
        if len(self._over) > OVER_REMEMBERED:
            self._over.popitem(last=False)

    def abandon(self, number: int) -> None:
        """Drop this message: the sender does not send the rest."""
        partial = self._partials.get(number)
        if partial is not None:
            self._remove(partial)
            self._dropped["reassembly_abandoned"] += 1
        if number not in self._over:
            self._remember(number, Fate.ABANDONED)

    def forgo(self, number: int) -> None:
        """Mark a finished message as forgotten, since it has no room to be decoded: further symbols get FORGOTTEN."""
        self._over[number] = Fate.FORGOTTEN

    def expire(self, now: float) -> None:
        """Drop messages that got no symbol for MAX_SILENCE_S."""
        while self._partials and next(iter(self._partials.values())).touched_at + MAX_SILENCE_S <= now:
            self._forget_oldest("reassembly_expired")
