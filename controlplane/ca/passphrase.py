"""Gets the passphrase of a CA's key from a file, the environment, or the user at the terminal.

Without a terminal nobody is asked: a command in a script ends with one line that says what to give it.
"""

from __future__ import annotations

import getpass
import os
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING

from plr.protos.base.errors import ConfigError
from plr.protos.program.tls_files import read_guarded

if TYPE_CHECKING:
    from pathlib import Path

VARIABLE = "PLR_CA_PASSPHRASE"
NEW_VARIABLE = "PLR_CA_NEW_PASSPHRASE"

MIN_PASSPHRASE_BYTES = 8
"""Shorter ones are found by trial, however costly a guess is; NIST SP 800-63B sets the same minimum."""

MAX_PASSPHRASE_BYTES = 1023
"""The longest that OpenSSL accepts."""

_NOT_THE_OWNER = 0o077


@dataclass(frozen=True, slots=True)
class PassphraseSource:
    """A passphrase that can be given in a file (by `option`), else in the environment (`variable`)."""

    what: str
    option: str
    variable: str
    file: Path | None = None

    def given(self) -> bytes | None:
        """Return the passphrase, or None if none was given; raises ConfigError."""
        if self.file is not None:
            return _not_empty(read_guarded(self.file, _NOT_THE_OWNER).strip(b"\r\n"), str(self.file))
        text = os.environ.get(self.variable)
        return None if text is None else _not_empty(os.fsencode(text), self.variable)

    def get(self) -> bytes:
        """Return the passphrase, asking for it if need be; raises ConfigError."""
        passphrase = self.given()
        if passphrase is not None:
            return passphrase
        self._expect_terminal("")
        return _not_empty(_ask(f"{self.what}: "), self.what)

    def choose(self) -> bytes:
        """Return a passphrase for a key yet to be encrypted, asking twice if need be; raises ConfigError."""
        passphrase = self.given()
        if passphrase is not None:
            return _checked(passphrase, self.variable if self.file is None else str(self.file))
        self._expect_terminal(", or --no-passphrase to leave the CA's key unencrypted")
        passphrase = _checked(_ask(f"{self.what} (at least {MIN_PASSPHRASE_BYTES} characters): "), self.what)
        if _ask("again: ") != passphrase:
            raise ConfigError(self.what, "", "the two differ; nothing was changed")
        return passphrase

    def _expect_terminal(self, way_out: str) -> None:
        if sys.stdin is None or not sys.stdin.isatty():
            problem = f"there is no terminal to ask for it; give {self.option} FILE or set {self.variable}{way_out}"
            raise ConfigError(self.what, "", problem)


def _ask(prompt: str) -> bytes:
    try:
        return os.fsencode(getpass.getpass(prompt))
    except (EOFError, UnicodeError):
        return b""


def _not_empty(passphrase: bytes, where: str) -> bytes:
    if not passphrase:
        raise ConfigError(where, "", "expected a passphrase")
    return passphrase


def _checked(passphrase: bytes, where: str) -> bytes:
    if not MIN_PASSPHRASE_BYTES <= len(passphrase) <= MAX_PASSPHRASE_BYTES:
        raise ConfigError(where, "", f"expected a passphrase of {MIN_PASSPHRASE_BYTES} to {MAX_PASSPHRASE_BYTES} bytes")
    if b"\n" in passphrase or b"\0" in passphrase:
        raise ConfigError(where, "", "expected a passphrase on one line")
    return passphrase
