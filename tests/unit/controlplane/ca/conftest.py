from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from plr.controlplane.ca import key_file
from plr.controlplane.ca.passphrase import NEW_VARIABLE, VARIABLE
from tests.unit.controlplane.ca.shell import Shell

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def shell(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Shell:
    """A shell in a folder of its own, and without passphrases in its environment."""
    monkeypatch.chdir(tmp_path)
    for variable in (VARIABLE, NEW_VARIABLE):
        monkeypatch.delenv(variable, raising=False)
    return Shell(capsys)


@pytest.fixture
def cheap_guesses(monkeypatch: pytest.MonkeyPatch) -> None:
    """A passphrase takes 1 ms instead of half a second of a processor."""
    monkeypatch.setattr(key_file, "SCRYPT_N", 1 << 8)
    monkeypatch.setattr(key_file, "SCRYPT_P", 1)
