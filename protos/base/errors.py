"""Defines the errors that both planes raise."""

from __future__ import annotations

from plr.protos.base.printable import escaped


class DecodeError(ValueError):
    """Bytes or messages from the network break their format; the text names the broken rule."""


class UnknownKindError(DecodeError):
    """A message is of a kind that only a newer program knows: it is ignored, and is no reason to end anything."""


class ConfigError(ValueError):
    """A configuration is refused; the text is one line that names the file, the key and what was expected.

    It is safe for a terminal: unprintable characters in a key of the file or in a path are escaped.
    """

    def __init__(self, source: str, key: str, problem: str) -> None:
        super().__init__(escaped(": ".join(part for part in (source, key, problem) if part)))
        self.source = source
        self.key = key
        self.problem = problem


class StartError(ConfigError):
    """A configuration may be right but cannot be used here and now, such as a port that is taken."""
