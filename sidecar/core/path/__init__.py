"""One path: what its interface's thread owns of it, without a lock.

Imports `base`, `crypto`, `wire`, `message`, `seam` and its own `congestion`; nothing of the engine's half (ADR 4).
"""
