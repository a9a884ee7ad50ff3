"""Defines the lab's two errors, so that callers can tell their own mistakes from the machine's."""

from __future__ import annotations


class LabError(RuntimeError):
    """The lab could not be built, or a part of it died; the text says which part and why."""


class LabConfigError(ValueError):
    """A topology, link profile or trace is invalid; the text names the field."""
