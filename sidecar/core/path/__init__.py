"""Holds the state of one path, which its interface's thread owns without a lock.

Imports `base`, `crypto`, `wire`, `message`, `seam` and its own `congestion`; nothing of the engine's half (ADR 4).
"""
