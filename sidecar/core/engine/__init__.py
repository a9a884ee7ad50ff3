"""Holds what stands behind the engine's lock: the role, the peers, what passes between links and application.

Imports everything but `path` and `link` (ADR 4).
"""
