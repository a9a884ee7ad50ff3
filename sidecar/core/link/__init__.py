"""One interface and its paths, owned by the interface's thread, without a lock.

Imports `path` and what that imports; nothing of the engine's half (ADR 4).
"""
