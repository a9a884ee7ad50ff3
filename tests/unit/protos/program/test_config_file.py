"""Configurations that are no configurations: whatever they hold, one line says what is wrong, soon."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest

from plr.protos.base.errors import ConfigError
from plr.protos.program.config_file import MAX_VALUES, parse_yaml, read_text

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.audit("ops-2")


def bomb(levels: int) -> str:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]" for n in range(1, levels)]
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("port: 024700", "write 024700 without leading zeros or colons"),
        ("port: 1:30", "write 1:30 without leading zeros or colons"),
        ("port: 01.5", "write 01.5 without leading zeros or colons"),
        (f"port: 0x{'f' * 5000}", "no number may have more than 64 bits"),
        (f"port: 0b{'1' * 65}", "no number may have more than 64 bits"),
        (f"? 0x{'f' * 64}\n: 1", "no number may have more than 64 bits"),
        ("port: " + "59:" * 200_000 + "59", "no number may have more than 64 bits"),
        ("port: " + "59:" * 200_000 + "59.5", "no number may have more than 64 bits"),
        ("a: &a [*a]", "an alias must not occur within what it names"),
        ("a: &a {b: {c: *a}}", "an alias must not occur within what it names"),
        (bomb(9), f"at most {MAX_VALUES} values"),
        ("[" * 5000, "expected YAML"),
    ],
    ids=lambda text: text[:20],
)
def test_what_would_cost_too_much_is_refused(text: str, told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        parse_yaml(text, "x.yaml")


def test_an_alias_that_saves_writing_is_taken() -> None:
    assert parse_yaml("a: &a [1, 0x10]\nb: *a\nc: {<<: {d: 1.5}, e: 2}", "x") == {
        "a": [1, 16], "b": [1, 16], "c": {"d": 1.5, "e": 2},
    }  # fmt: skip


def test_what_is_no_file_is_not_waited_for(tmp_path: Path) -> None:
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    with pytest.raises(ConfigError, match="fifo: cannot be read: it is not a regular file"):
        read_text(fifo)
    with pytest.raises(ConfigError, match="cannot be read: Is a directory"):
        read_text(tmp_path)
    with pytest.raises(ConfigError, match="cannot be read: its name contains a NUL"):
        read_text(tmp_path / "a\0b")


def test_what_is_told_moves_no_cursor() -> None:
    error = ConfigError("a\x1b[2J", "k\x07\n", "got \u202e, which is \udcff")
    assert str(error) == "a\\x1b[2J: k\\x07\\n: got \\u202e, which is \\udcff"
    assert error.key == "k\x07\n"
