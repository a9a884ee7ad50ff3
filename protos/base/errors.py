"""Errors that both planes raise."""

from __future__ import annotations

from protos.base.printable import escaped


class DecodeError(ValueError):
    """Bytes or messages from the network break their format; the text tells which rule of it."""


class UnknownKindError(DecodeError):
    """A message of a kind that only a newer program knows: to be left out, and no reason to end anything."""


class ConfigError(ValueError):
    """A configuration is refused; the text is one line that names the file, the key and what was expected.

    It is fit for a terminal: what is not printable, in a key of the file or in a path, is escaped.
    """

    def __init__(self, source: str, key: str, problem: str) -> None:
        super().__init__(escaped(": ".join(part for part in (source, key, problem) if part)))
        self.source = source
        self.key = key
        self.problem = problem


class StartError(ConfigError):
    """A configuration that may be right cannot be had here and now, such as a port that somebody else has."""
