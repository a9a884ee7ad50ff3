"""Holds what stands behind the engine's lock: both roles, the peers, what passes between links and application.

Imports everything but `path` and `link` (ADR 4).
"""
