"""Takes secrets out of text that leaves a node. Pure.

Nothing that holds secrets is collected in the first place; this is for what a person wrote into a configuration, a
passphrase on a command line in the journal, a key pasted into a comment.
"""

from __future__ import annotations

import re
from typing import Any

LEFT_OUT = "(left out)"

_PEM = re.compile(r"-----BEGIN ([A-Z0-9 ]*)-----.*?(?:-----END \1-----|\Z)", re.DOTALL)
_WORDS = r"pass(?:phrase|word|wd)?|secret|token|credential|api[-_]?key|private[-_]?key|authorization|cookie"
_NAMED = re.compile(
    rf"""(?ix) (["']?\b[\w.-]*(?:{_WORDS})[\w.-]*["']?\s*(?:=|:)\s*)  (?:(?:bearer|basic)\s+)?
    ("(?:[^"\\]|\\.)*" | '(?:[^'\\]|\\.)*' | [^\s,;}}\]]+)"""
)
"""A name that says secret, then = or :, then the value."""
_OPTION = re.compile(rf"(?i)(--[\w-]*(?:{_WORDS})[\w-]*)[ =]+(\S+)")
_USER = re.compile(r"(\b[a-z][a-z0-9+.-]*://)[^/\s@]+@")
_LONG_HEX = re.compile(r"\b[0-9a-fA-F]{32,}\b")
_LONG_BASE64 = re.compile(r"(?<![\w/+=-])(?=[\w/+-]*\d)(?=[\w/+-]*[A-Z])(?=[\w/+-]*[a-z])[A-Za-z0-9/+_-]{40,}={0,2}")
"""40 characters and more of all three kinds in a row: no word of ours, no path without a slash."""
_SECRET_KEY = re.compile(rf"(?i)(?:{_WORDS})")


def scrubbed(text: str) -> str:
    """Return the text without what is, or is called, a secret."""
    text = _PEM.sub(lambda found: f"({found[1].strip() or 'PEM'} left out)", text)
    text = _USER.sub(rf"\1{LEFT_OUT}@", text)
    text = _OPTION.sub(rf"\1 {LEFT_OUT}", text)
    text = _NAMED.sub(rf"\1{LEFT_OUT}", text)
    text = _LONG_HEX.sub(LEFT_OUT, text)
    return _LONG_BASE64.sub(_base64, text)


def _base64(found: re.Match[str]) -> str:
    # A path has such a length too, and is worth reading.
    return found[0] if found[0].count("/") >= 3 else LEFT_OUT


def scrubbed_value(value: Any) -> Any:
    """Return a value of YAML or JSON without what is, or is called, a secret."""
    if isinstance(value, dict):
        return {
            str(key): LEFT_OUT if _SECRET_KEY.search(str(key)) and isinstance(inner, str) else scrubbed_value(inner)
            for key, inner in value.items()
        }
    if isinstance(value, list | tuple):
        return [scrubbed_value(inner) for inner in value]
    return scrubbed(value) if isinstance(value, str) else value
