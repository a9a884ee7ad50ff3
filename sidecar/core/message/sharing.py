"""Lets several paths carry one message together: each pulls the next symbol when it has room for one.

A symbol that no path has taken yet goes to whichever asks first, so each path carries what it can at the moment. A path
says at each turn how fast it is. From this the others know when the rest would be over without them: a path leaves a
symbol alone that would arrive sooner over the others. When no symbol is left to take, a path that has nothing better to
do repeats symbols that others still carry, the newest first: redundancy is what spare capacity is used for, and it ends
by itself under load.

A symbol that got lost is untaken again.

Links on several threads share this without a lock. They take from a deque, which is atomic in CPython, the engine gives
back to it, and each link writes its own offer. Whoever reads an old offer leaves a symbol alone, or takes one, that
another path would have carried a little sooner.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

OFFER_S = 0.1
"""An offer is void after this time (s): a path that has room and works would have renewed it."""


class Offer(NamedTuple):
    """What a path can do for a message, as it said last."""

    pace: float
    """Bytes a second."""
    round_trip_s: float
    at: float


class Sharing:
    """What the paths that carry one message together know of each other."""

    __slots__ = ("_offers", "_untaken", "_waits", "repeats")

    def __init__(self, symbols: int, repeats: int) -> None:
        """Begin with all `symbols` untaken; at most about `repeats` of them are carried by more than one path."""
        self._untaken = deque(range(symbols))
        self._waits = bytearray(b"\1" * symbols)
        """For each symbol, whether it is untaken."""
        self._offers: dict[object, Offer | None] = {}
        self.repeats = repeats
        """Symbols that may still be repeated."""

    @property
    def untaken(self) -> int:
        """Number of symbols that no path has taken."""
        return len(self._untaken)

    def join(self, path: object) -> None:
        """Let another path carry it too."""
        self._offers.setdefault(path, None)

    def leave(self, path: object) -> tuple[int, ...]:
        """Take a path out; return the untaken symbols if it was the last one: nobody would carry them."""
        self._offers.pop(path, None)
        return () if self._offers else self.take_all()

    def take(self, most: int, needs: Callable[[int], bool]) -> tuple[int, int] | None:
        """Remove and return the next consecutive symbols as (first, count), at most `most`; None if none is left."""
        untaken, waits = self._untaken, self._waits
        run: tuple[int, int] | None = None
        while run is None or run[1] < most:
            try:
                index = untaken.popleft()
            except IndexError:
                break
            if needs(index):
                if run is None:
                    run = index, 1
                elif index == run[0] + run[1]:
                    run = run[0], run[1] + 1
                else:
                    untaken.appendleft(index)
                    break
            waits[index] = 0
        return run

    def give_back(self, indices: Iterable[int]) -> None:
        """Let these symbols, which got lost, be taken again before all others."""
        again = [index for index in indices if not self._waits[index]]
        for index in again:
            self._waits[index] = 1
        self._untaken.extendleft(reversed(again))

    def take_all(self) -> tuple[int, ...]:
        """Remove and return all symbols that no path has taken."""
        untaken = self._untaken
        taken: list[int] = []
        while untaken:
            try:
                taken.append(untaken.popleft())
            except IndexError:
                break
            self._waits[taken[-1]] = 0
        return tuple(taken)

    def offer(self, path: object, pace: float, round_trip_s: float, now: float) -> None:
        """Note how fast a path is now that it has room (bytes a second; 0: unknown)."""
        self._offers[path] = Offer(pace, round_trip_s, now) if pace else None

    def withdraw(self, path: object) -> None:
        """Note that a path sends something else first."""
        if path in self._offers:
            self._offers[path] = None

    def others(self, path: object, now: float) -> tuple[float, float]:
        """Return the summed pace (bytes a second) of the other paths, and the shortest of their round trips (s).

        The pace is 0 if none of them has said lately that it can do anything.
        """
        fresh = _fresh((offer for other, offer in list(self._offers.items()) if other is not path), now)
        return sum(offer.pace for offer in fresh), min((offer.round_trip_s for offer in fresh), default=0.0)


def _fresh(offers: Iterable[Offer | None], now: float) -> list[Offer]:
    return [offer for offer in offers if offer is not None and now - offer.at <= OFFER_S]
