"""Receives messages: one reassembler for each peer, and the line of those to be decoded."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from plr.sidecar.core.message.decoding import Decoding, DecodingLine
from plr.sidecar.core.message.partial import Partial
from plr.sidecar.core.message.reassembly import OVER_REMEMBERED, Fate, Reassembler
from plr.sidecar.core.seam.links import SendFinished, SendForgotten
from plr.sidecar.core.wire.frame import BASE_SYMBOL_BYTES

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from plr.protos.model.ids import NodeName, SessionId
    from plr.sidecar.core.base.values import PathId
    from plr.sidecar.core.seam.links import PathCommand
    from plr.sidecar.core.seam.stats import EngineStats
    from plr.sidecar.core.wire.frame import Fragment


class Arrived(NamedTuple):
    """A message that is whole, and when it stops being of use."""

    content: memoryview
    ends_at: float
    beside: tuple[PathId, ...] = ()
    """Further paths by which some of it came."""


class Inbound:
    """The unfinished messages of all peers."""

    def __init__(self, command: Callable[[PathCommand], None], stats: EngineStats, *, answers: bool) -> None:
        """Create it empty; `answers`: nearly every message is answered, so what its sender is owed soon has company."""
        self._command = command
        self._stats = stats
        self._answers = answers
        self._reassemblers: dict[NodeName, Reassembler] = {}
        self._line = DecodingLine()
        self._untold: dict[NodeName, dict[int, None]] = {}
        """Finished messages whose peer could not be told for lack of a path, oldest first."""

    def add(self, path: PathId, session: SessionId, fragments: list[Fragment], now: float) -> list[Arrived]:
        """Store symbols that came over `path`; return the messages that they complete."""
        reassembler = self._reassemblers.get(path.peer)
        if reassembler is None:
            reassembler = self._reassemblers[path.peer] = Reassembler(path.peer, self._stats.dropped)
        whole: list[Arrived] = []
        for number, fate, content, ends_at, paths in reassembler.add(fragments, now, path):
            if fate is Fate.FORGOTTEN:
                self._command(SendForgotten(path, number))
                continue
            if isinstance(content, Partial) and not self._line.fits(path.peer, content):
                # Its sender sends it again, as another message.
                self._stats.dropped["decoding_full"] += 1
                reassembler.forgo(number)
                self._command(SendForgotten(path, number))
                continue
            # Even if it still has to be decoded: nothing more could help.
            self._command(SendFinished(path, number, at_once=not (self._answers and _is_small(content))))
            if isinstance(content, Partial):
                self._line.add(Decoding(path, session, content))
            elif content is not None:
                whole.append(Arrived(content, ends_at, _beside(path, paths) if len(paths) > 1 else ()))
        return whole

    def on_finished_lost(self, peer: NodeName, numbers: tuple[int, ...], best: PathId | None) -> None:
        """Report FINISHED of a path that died to the peer over `best`, or once there is a path.

        Its sender has nothing left to send, and would keep the messages until they expire.
        """
        if best is not None:
            for number in numbers:
                self._command(SendFinished(best, number))
            return
        untold = self._untold.setdefault(peer, {})
        untold.update(dict.fromkeys(numbers))
        while len(untold) > OVER_REMEMBERED:
            del untold[next(iter(untold))]
            self._stats.dropped["finished_untold"] += 1

    def on_path_up(self, path: PathId) -> None:
        """Report FINISHED of messages to a peer that had no path."""
        for number in self._untold.pop(path.peer, ()):
            self._command(SendFinished(path, number))

    def next_decoding(self) -> Decoding | None:
        """Return the message of which to compute a slice next."""
        return self._line.next()

    @property
    def decodings(self) -> int:
        """Number of messages to be decoded."""
        return len(self._line)

    def forgo_decoding(self, decoding: Decoding) -> None:
        """Drop a message that cannot be computed."""
        if self._line.done(decoding):
            self._stats.dropped["decoding_failed"] += 1

    def take_decoded(self, decoding: Decoding) -> Arrived | None:
        """Return a computed message, unless its session is over."""
        if not self._line.done(decoding):
            return None
        partial = decoding.partial
        return Arrived(partial.whole(), partial.ends_at, _beside(decoding.path, partial.paths))

    def abandon(self, peer: NodeName, number: int) -> None:
        """Drop this message: the peer does not send the rest."""
        reassembler = self._reassemblers.get(peer)
        if reassembler is not None:
            reassembler.abandon(number)

    def forget_peer(self, peer: NodeName) -> None:
        """Drop a peer whose session is over."""
        self._reassemblers.pop(peer, None)
        self._stats.dropped["fragment_of_old_session"] += self._line.forget_peer(peer)
        self._untold.pop(peer, None)

    def expire(self, now: float) -> None:
        """Drop messages that wait too long."""
        for reassembler in self._reassemblers.values():
            reassembler.expire(now)


def _beside(path: PathId, paths: Sequence[PathId]) -> tuple[PathId, ...]:
    return tuple(other for other in paths if other != path)


def _is_small(content: memoryview | Partial | None) -> bool:
    """Return whether a message came whole in one datagram: none of its symbols waits at its sender for FINISHED."""
    return isinstance(content, memoryview) and len(content) <= BASE_SYMBOL_BYTES
