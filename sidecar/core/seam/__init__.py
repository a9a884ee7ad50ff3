"""Defines what passes between engine and links and over the core's border: commands, events, counters.

Imports `base`, `crypto`, `wire` and `message`. Both halves of the core import it, and never each other (ADR 4).
"""
