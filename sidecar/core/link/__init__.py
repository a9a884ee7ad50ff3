"""Runs one interface and its paths, which the interface's thread owns without a lock.

Imports `path` and what that imports; nothing of the engine's half (ADR 4).
"""
