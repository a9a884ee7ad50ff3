"""Finds how large a datagram one path carries: PLPMTUD (RFC 8899; RFC 9000 section 14.3).

Sizes are bytes of UDP payload. Every path starts at BASE_BYTES, which need not be proven. Probes, padded to the size
under test and answered by a small PROBE_REPLY, step through common sizes up to what the local interface takes. A
confirmed size holds at once. ICMP is never believed. A lost probe is neither congestion nor a failure of the path.

Two things return a path to the base: full-sized datagrams that vanish while small ones pass (a black hole, RFC 8899
section 4.3: the route changed), and the path having been down (its route may have changed).
"""

from __future__ import annotations

from functools import lru_cache

from plr.sidecar.core.wire.frame import BASE_BYTES, MAX_DATAGRAM_BYTES

COMMON_MTUS = (1280, 1400, 1420, 1492, 1500, 4096, 9000)
"""MTUs tried, where the interface takes them: IPv6's minimum, mobile networks, WireGuard, PPPoE, Ethernet, jumbo
frames. The interface's own MTU is always tried last."""
MAX_PROBES = 3
"""Unanswered probes after which a size counts as too large (RFC 8899 section 5.1.2)."""
PROBE_TIMEOUT_S = 1.0
"""Time after which a probe is unanswered (RFC 8899 section 5.1.1), or some round trips of a slower path if longer."""
RAISE_EVERY_S = 600.0
"""Interval of searches for a larger size (RFC 8899 section 5.1.1)."""
RETRY_S = 10.0
"""First new search after a black hole. It doubles up to RAISE_EVERY_S with each further one, so that a path that
carries probes but no data is left alone."""
BLACK_HOLE_LOST = 6
"""Datagrams above the base, lost in a row (once in 60 million at 5 % random loss), ..."""
BLACK_HOLE_REPORTS = 2
"""... and found lost on as many occasions, since one burst takes many at once."""

HEADERS_V4 = 28
HEADERS_V6 = 48
"""IP and UDP headers, without options."""
LEAST_MTU = BASE_BYTES + HEADERS_V4
"""Least MTU of an interface, below which datagrams of BASE_BYTES do not leave."""
PROBES_REMEMBERED = 2 * MAX_PROBES
"""Probes whose late reply still counts."""


@lru_cache(maxsize=64)
def payloads(mtu: int, *, ipv6: bool) -> tuple[int, ...]:
    """Return the sizes to try at this interface MTU (bytes), ascending: above BASE_BYTES, up to MAX_DATAGRAM_BYTES."""
    headers = HEADERS_V6 if ipv6 else HEADERS_V4
    sizes = {min(candidate, mtu) - headers for candidate in COMMON_MTUS} | {mtu - headers}
    return tuple(sorted({min(size, MAX_DATAGRAM_BYTES) for size in sizes if size > BASE_BYTES}))


class PathMtu:
    """The size of one path's datagrams, and the search for a larger one."""

    __slots__ = (
        "_at",
        "_hole_at",
        "_holes",
        "_out",
        "_probed_at",
        "_reports",
        "_row",
        "_sizes",
        "_small_passed",
        "_target",
        "_told",
        "_tries",
        "size",
    )

    def __init__(self) -> None:
        self.size = BASE_BYTES
        """Largest datagram that may be sent, in bytes."""
        self._told: tuple[int, ...] = ()
        self._sizes: tuple[int, ...] = ()
        """Sizes to try: as given to `start`, or fewer after the kernel refused one."""
        self._at: float | None = None
        self._target: int | None = None
        """The size under test; None between two searches."""
        self._tries = 0
        self._probed_at = float("-inf")
        self._out: dict[int, int] = {}
        """Sizes of the latest probes by their id."""
        self._holes = 0
        self._hole_at = 0.0
        self._forgive()

    # -- the path's life ------------------------------------------------------------------------------------------

    def start(self, sizes: tuple[int, ...], now: float) -> bool:
        """Search on a path that is up over an interface that takes these `payloads`, unless they are known.

        Returns True if datagrams get smaller.
        """
        if self._at is not None and sizes == self._told:
            return False
        limit = sizes[-1] if sizes else BASE_BYTES
        lowered = self.size > limit
        self.size = min(self.size, limit)
        self._told = sizes
        self._search(sizes, now)
        return lowered

    def stop(self) -> bool:
        """Return to the base without probing, as the path is down or leads elsewhere; True if it was above the base."""
        lowered = self._to_base()
        self._at = None
        return lowered

    # -- probing --------------------------------------------------------------------------------------------------

    @property
    def timer(self) -> float | None:
        """When `next_probe` is wanted; None while there is no search."""
        return self._at

    def next_probe(self, probe_id: int, now: float, timeout_s: float = PROBE_TIMEOUT_S) -> int | None:
        """Return the size of the probe that leaves now under this id; None if none is due.

        `timeout_s` is how long its reply may take, at least PROBE_TIMEOUT_S.
        """
        if self._at is None or now < self._at:
            return None
        if self._target is None:
            self._target = self._above()
            self._tries = 0
        if self._target is None or self._tries == MAX_PROBES:
            self._rest(now)
            return None
        self._tries += 1
        self._probed_at = now
        self._at = now + max(timeout_s, PROBE_TIMEOUT_S)
        self._out[probe_id] = self._target
        if len(self._out) > PROBES_REMEMBERED:
            del self._out[next(iter(self._out))]
        return self._target

    def on_reply(self, probe_id: int, now: float) -> bool:
        """Take a PROBE_REPLY; return False if it answers none of these probes."""
        size = self._out.pop(probe_id, None)
        if size is None:
            return False
        if size > self.size:
            self.size = size
            self._forgive()
            if self._target is None or self._target <= size:
                # Also if it comes so late that the search was given up.
                self._target = None
                self._at = now
        return True

    def _search(self, sizes: tuple[int, ...], now: float) -> None:
        self._sizes = sizes
        self._target = None
        self._out.clear()
        # A path that changes again and again must not be filled with large probes.
        self._at = max(now, self._probed_at + PROBE_TIMEOUT_S)

    def _above(self) -> int | None:
        """Return the next size worth testing."""
        return next((size for size in self._sizes if size > self.size), None)

    def _rest(self, now: float) -> None:
        self._target = None
        self._at = now + RAISE_EVERY_S

    # -- outcomes of data -----------------------------------------------------------------------------------------

    def on_delivered(self, size: int) -> None:
        """Note that a datagram of this many bytes was acknowledged or answered."""
        if size > BASE_BYTES:
            self._forgive()
        elif self._row:
            self._small_passed = True

    def on_lost(self, count: int, now: float) -> bool:
        """Note `count` datagrams above BASE_BYTES found lost at once; return True if datagrams get smaller."""
        if self.size == BASE_BYTES:
            return False
        self._row += count
        self._reports += 1
        if self._row < BLACK_HOLE_LOST or self._reports < BLACK_HOLE_REPORTS or not self._small_passed:
            return False
        self._holes = 1 if now > self._hole_at + RAISE_EVERY_S else self._holes + 1
        self._hole_at = now
        self._to_base()
        self._at = now + min(RETRY_S * 2.0 ** (self._holes - 1), RAISE_EVERY_S)
        return True

    def on_too_big(self, size: int, now: float) -> bool:
        """Note that the interface's kernel refused to send this many bytes; return True if datagrams get smaller."""
        if size <= BASE_BYTES or self._at is None:
            return False
        lowered = self.size >= size
        if not lowered and (self._target is None or self._target < size):
            return False
        smaller = tuple(known for known in self._sizes if known < size)
        if lowered:
            self.size = smaller[-1] if smaller else BASE_BYTES
        self._search(smaller, now)
        return lowered

    def _forgive(self) -> None:
        self._row = 0
        self._reports = 0
        self._small_passed = False

    def _to_base(self) -> bool:
        lowered = self.size > BASE_BYTES
        self.size = BASE_BYTES
        self._target = None
        self._out.clear()
        self._forgive()
        return lowered
