"""Measures the cost of renewing keys: a path whose ends agree on new ones every second, beside one that keeps them.

That is 120 times as often as by default. The two take turns. A single exchange is timed separately, in this process.
"""

from __future__ import annotations

import contextlib
import random
import time
from typing import TYPE_CHECKING

from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey

from bench.dataplane.ours import SERVICE, Ours
from bench.dataplane.section import Findings, Section, table_of
from bench.dataplane.statistics import MS, Row, goodput_of_stretches, interval, median, median_ratio, p99_ratio
from plr.protos.trust.credential import Aead
from plr.sidecar.core.crypto.key_schedule import PairKeys
from plr.sidecar.core.path.key_exchange import RENEW_AFTER_S, KeyExchange, KeyLimits

if TYPE_CHECKING:
    from bench.dataplane.section import Context

OFTEN_S, NEVER_S = 1, 86_400
"""Minimum and maximum of a sidecar's `rekey_after_s`."""
SMALL = {"size": 1_000, "rate_hz": 100.0}
SMALL_COUNT = 1_500
BULK_BYTES = 1_000_000
BULK = {"size": BULK_BYTES, "at_once": 8, "grace_s": 60.0}
BULK_COUNT = 1_000
WARM_UP = 50
EXCHANGES = 500
PATIENT = {**SERVICE, "deadline_ms": 20_000.0, "lifetime_ms": 60_000.0}


def measure(context: Context) -> Findings:
    """Measure."""
    rows: dict[str, list[Row]] = {"kept": [], "renewed": []}
    pooled: dict[str, list[float]] = {"kept": [], "renewed": []}
    goodput: dict[str, list[float]] = {"kept": [], "renewed": []}
    with contextlib.ExitStack() as stack:
        pairs = {
            name: stack.enter_context(
                Ours(context.folder, clouds={"cloud_a": None}, service=PATIENT, name=name, rekey_after_s=seconds)
            )
            for name, seconds in (("kept", NEVER_S), ("renewed", OFTEN_S))
        }
        for pair in pairs.values():
            pair.call(**BULK, count=WARM_UP)
        for repeat in range(context.repeats):
            for name, pair in pairs.items():
                context.say(f"keys: {name}, {repeat + 1} of {context.repeats}")
                small = pair.call(**SMALL, count=context.scaled(SMALL_COUNT, WARM_UP))
                rows[name].append(small.row(f"1 kB, keys {name}"))
                pooled[name] += small.answered_ms()
                bulk = pair.call(**BULK, count=context.scaled(BULK_COUNT, WARM_UP))
                goodput[name] += goodput_of_stretches(bulk, BULK_BYTES)
    exchange_ms = _exchange_ms()
    return Findings(
        figures={
            "keys_p99_renewed_over_kept": p99_ratio(pooled["renewed"], pooled["kept"]),
            "keys_goodput_renewed_over_kept": median_ratio(goodput["renewed"], goodput["kept"]),
            "keys_lost": sum(row.lost for run in rows.values() for row in run),
            "keys_exchange_cpu_ms": exchange_ms,
            "keys_share_of_processor": exchange_ms / MS / RENEW_AFTER_S,
        },
        intervals={
            "keys_p99_renewed_over_kept": interval(p99_ratio, pooled["renewed"], pooled["kept"]),
            "keys_goodput_renewed_over_kept": interval(median_ratio, goodput["renewed"], goodput["kept"]),
        },
        tables=[
            table_of(
                "1 kB at 100 Hz; keys renewed every second, or never",
                [Row.of_repeats(run) for run in rows.values()],
            )
        ],
        notes=[
            f"Goodput, Mbit/s: kept {median(goodput['kept']) or 0:.0f}, renewed {median(goodput['renewed']) or 0:.0f}.",
            f"One exchange takes both ends together {exchange_ms:.2f} ms of a processor: by default one for each path "
            f"in {RENEW_AFTER_S:.0f} s.",
        ],
    )


def _exchange_ms() -> float:
    """Return the processor time of one exchange, for both ends."""
    rng = random.Random(1)
    one, other = (X25519PrivateKey.from_private_bytes(rng.randbytes(32)) for _ in range(2))
    leader, follower = (
        KeyExchange(
            PairKeys(bytes(32), Aead.CHACHA20_POLY1305, leads, own, theirs.public_key()),
            bytes(32),
            KeyLimits(),
            0.0,
            leads=leads,
        )
        for own, theirs, leads in ((one, other, True), (other, one, False))
    )
    began_s = time.process_time()
    now = 0.0
    for _ in range(EXCHANGES):
        now += 2 * RENEW_AFTER_S
        offer = leader.offer(0, now, rng)
        assert offer is not None
        answer = follower.answer(offer, now, rng)
        assert answer is not None
        assert leader.take(answer[0], now) is not None
        follower.confirmed(now)
    return (time.process_time() - began_s) * MS / EXCHANGES


SECTION = Section("keys", "The price of renewed keys", measure)
