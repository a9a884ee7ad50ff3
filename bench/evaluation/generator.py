"""Generates seeded random traces of two paths. The same kind, seed and length give the same trace.

Each rate is a quantile function of a Gaussian score, the sum of a slow and a quick first-order autoregressive process
(a Gaussian copula over time); the innovations of the two paths are correlated. Outages of each path and dead zones of
both are two-state Markov chains.
"""

from __future__ import annotations

import math
import zlib
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import ndtr

from bench.evaluation.kinds import DEAD_ZONE_FACTOR, KINDS
from lab import LinkProfile, Trace, TraceStep

if TYPE_CHECKING:
    from bench.evaluation.carriers import Carrier, Floats
    from bench.evaluation.kinds import Kind

RTT_MEMORY_S = 2.0
"""Seconds in which the autocorrelation of the base round-trip time falls to 1/e."""


def generate(kind: str, seed: int, duration_s: float) -> Trace:
    """Generate a trace of a kind in `KINDS` (else KeyError) that lasts `duration_s`."""
    return generate_kind(KINDS[kind], f"{kind}-{seed}", duration_s)


def generate_kind(kind: Kind, name: str, duration_s: float) -> Trace:
    """Generate a trace named `name`, which is also the seed."""
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    steps = max(1, round(duration_s / kind.step_s))
    carriers = (kind.a, kind.b)
    slow, fast = (_innovations(rng, steps, kind.common) for _ in range(2))
    dead = _chain(rng, steps, kind.step_s, kind.dead_every_s, kind.dead_s)
    paths = {}
    for number, carrier in enumerate(carriers):
        score = math.sqrt(carrier.slow_share) * _autoregressive(slow[number], kind.step_s / carrier.slow_s)
        score += math.sqrt(1 - carrier.slow_share) * _autoregressive(fast[number], kind.step_s / carrier.fast_s)
        rates = carrier.rate_at(ndtr(score))
        rates[dead] *= DEAD_ZONE_FACTOR
        rates[_chain(rng, steps, kind.step_s, carrier.outage_every_s, carrier.outage_s)] = 0.0
        for blackout in kind.blackouts:
            if "ab"[number] in blackout.paths:
                rates[round(blackout.begin * steps) : round(blackout.end * steps)] = 0.0
        paths["ab"[number]] = _steps(carrier, rates, _rtts(rng, carrier, steps, kind.step_s), kind.step_s)
    return Trace(name, paths)


def _innovations(rng: np.random.Generator, steps: int, correlation: float) -> Floats:
    draws = rng.standard_normal((2, steps))
    draws[1] = correlation * draws[0] + math.sqrt(1 - correlation**2) * draws[1]
    return draws


def _autoregressive(innovations: Floats, steps_over_memory: float) -> Floats:
    """Return a stationary process of variance 1."""
    memory = math.exp(-steps_over_memory)
    fresh = math.sqrt(1 - memory**2)
    values = np.empty_like(innovations)
    value = values[0] = innovations[0]
    for index in range(1, len(innovations)):
        value = values[index] = memory * value + fresh * innovations[index]
    return values


def _chain(rng: np.random.Generator, steps: int, step_s: float, every_s: float, length_s: float) -> np.ndarray:
    """Return where a stationary two-state chain is in its rare state."""
    if math.isinf(every_s):
        return np.zeros(steps, bool)
    enter, leave = min(1.0, step_s / every_s), min(1.0, step_s / length_s)
    draws = rng.random(steps)
    inside = bool(draws[0] < enter / (enter + leave))
    states = np.empty(steps, bool)
    states[0] = inside
    for index in range(1, steps):
        inside = bool(draws[index] >= leave) if inside else bool(draws[index] < enter)
        states[index] = inside
    return states


def _rtts(rng: np.random.Generator, carrier: Carrier, steps: int, step_s: float) -> Floats:
    score = _autoregressive(rng.standard_normal(steps), step_s / RTT_MEMORY_S)
    rtts: Floats = carrier.rtt_ms * np.exp(carrier.rtt_sigma * score)
    return rtts


def _steps(carrier: Carrier, rates: Floats, rtts: Floats, step_s: float) -> tuple[TraceStep, ...]:
    steps = []
    for index, (rate, rtt) in enumerate(zip(rates.tolist(), rtts.tolist(), strict=True)):
        up = LinkProfile(delay_ms=rtt / 2, loss=carrier.loss, rate_kbps=rate)
        down = LinkProfile(delay_ms=rtt / 2, loss=carrier.loss, rate_kbps=rate / carrier.up_share)
        steps.append(TraceStep(round(index * step_s, 6), up, down))
    return tuple(steps)
