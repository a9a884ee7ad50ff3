"""Defines the targets of the control plane's figures, each for fleets of several sizes, from one run."""

from __future__ import annotations

from bench.reporting.targets import Target

SIZES = (500, 1000, 2000, 4000)
REGISTERED_S = {500: 5, 1000: 10, 2000: 20, 4000: 40}
CORE_SHARE = {1000: 0.25, 4000: 0.60}
REMAPPED_S = {500: 0.5, 4000: 1.5}
LOOP_HOLD_MS = {1000: 20, 4000: 50}


def targets(sizes: tuple[int, ...] = SIZES) -> tuple[Target, ...]:
    """Return the targets of fleets of these sizes."""
    found: list[Target] = []
    for size in sizes:
        if size in REGISTERED_S:
            meaning = "from the start of the control plane after a kill until all are registered, s"
            found.append(Target(f"registered_s_{size}", meaning, at_most=REGISTERED_S[size]))
        found.append(Target(f"leases_lost_{size}", "leases that ended while all were there", at_most=0))
        if size in CORE_SHARE:
            meaning = "share of one core that the control plane takes while nothing happens"
            found.append(Target(f"steady_core_share_{size}", meaning, at_most=CORE_SHARE[size]))
        meaning = "resident memory for each sidecar, kB (less that of a control plane without any)"
        found.append(Target(f"kb_a_sidecar_{size}", meaning, at_most=160))
        if size in REMAPPED_S:
            meaning = "P99 from a server's death to a robot's mapping without it, s"
            found.append(Target(f"remapped_p99_s_{size}", meaning, at_most=REMAPPED_S[size]))
        if size in LOOP_HOLD_MS:
            meaning = "longest turn of the event loop, processor time, ms"
            found.append(Target(f"loop_hold_ms_{size}", meaning, at_most=LOOP_HOLD_MS[size]))
        found.append(Target(f"status_s_{size}", "`plr status`, the start of the program included, s", at_most=1))
    return tuple(found)
