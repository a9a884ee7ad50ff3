"""Removes secrets from text that leaves a node. Pure.

Nothing that holds secrets is collected in the first place, and only the known keys of a configuration. This is for free
text: a passphrase on a command line in the journal, a key in an error. It removes too much rather than too little: the
rest of a line after a word such as password, and any long string of more than words and numbers. Time grows with the
length of the text, whatever its content.
"""

from __future__ import annotations

import re
from typing import Any

LEFT_OUT = "(left out)"
MAX_SCRUBBED_CHARACTERS = 2000
"""Maximum length of a line in characters; no useful line is longer."""
MAX_VALUE_LINES = 100
"""Maximum number of lines of a secret in brackets or quotes."""

_PEM = re.compile(r"-----BEGIN ([A-Z0-9 ]*)-----.*?(?:-----END \1-----|\Z)", re.DOTALL)
_NAME = re.compile(
    r"(?i)pass(?:phrase|word|wd|code)|secret|token|credential|authorization|cookie|bearer|api[-_ ]?key"
    r"|private[-_ ]?key|(?-i:(?<=[a-z])Keys?)(?=\"?'?\s*[=:])"
    r"|(?<![a-z])(?:pwd|psk)(?![a-z])|-pass(?![a-z])|(?<![a-z])(?:pass|keys?)(?=\"?'?\s*[=:])"
)
"""A value with such a name is a secret, and may consist of several words; [a-z] matches either case here."""
_NAME_GOES_ON = re.compile(r"[\w.-]*")
_OPENS = re.compile(r"[=:>|\[{(\\]")
_SAYS_SOMETHING = re.compile(r"[^\W_]")
_REFUSED_VALUE = re.compile(r"\b(got) ['\"\[{].*")
"""A value in a configuration error, which may be a secret under the wrong key."""
_USER_AND_SPACE = re.compile(r"://[^\s/@:]+:[^\s/@]*\s+@")
_DASHES = re.compile(r"(?:- +)*")
_NON_SPACE = re.compile(r"\S+")
_HEX_PAIRS = re.compile(r"(?:[0-9A-Fa-f]{2}:){15,}[0-9A-Fa-f]{2}")
"""A fingerprint or a key, longer than any address."""
_RUN = re.compile(r"[A-Za-z0-9+/_=-]{20,}")
"""The form of keys and tokens, but also of paths and names."""
_SEPARATORS = re.compile(r"[+/_=-]+")
_PLAIN = re.compile(
    r"[a-z]{0,24}\d{0,4}|[A-Z]{1,24}\d{0,4}|[a-z]{0,24}(?:[A-Z][a-z]{1,23}){0,8}\d{0,4}|\d{1,20}|\d{8}T\d{6}Z?"
)
"""A piece of a path or a name: a word, several words in camel case, a number, a time."""
_SHORT = 5
_MAX_ODD = 8
"""Maximum number of characters in short pieces that are no words, such as A1 or x86."""


def scrubbed(text: str) -> str:
    """Return the text without anything that is or is called a secret, in lines of MAX_SCRUBBED_CHARACTERS at most."""
    text = _PEM.sub(lambda found: f"({found[1].strip() or 'PEM'} left out)", text)
    lines = []
    named_at = -1
    """Column of the name of a secret whose value begins or continues in the lines below it; -1 if there is none."""
    is_first = False
    unclosed = _Unclosed()
    for whole in text.split("\n"):
        line = whole if len(whole) <= MAX_SCRUBBED_CHARACTERS else f"{whole[:MAX_SCRUBBED_CHARACTERS]}..."
        content = line.lstrip()
        if not content:
            lines.append("")
            continue
        indent = len(line) - len(content)
        if named_at >= 0:
            # The first line belongs to the value wherever it stands, and so do lines within a bracket or a quotation or
            # after a backslash. Further lines belong to it if they are indented or in a list.
            within = unclosed.goes_on()
            if is_first or within or indent > named_at or (indent == named_at and content.startswith("-")):
                is_first = False
                unclosed.take(content)
                lines.append(f"{line[: min(indent, MAX_SCRUBBED_CHARACTERS)]}{LEFT_OUT}")
                continue
            named_at = -1
        shown, value = _line(line)
        lines.append(shown)
        if value is not None:
            # In a list the value's lines are indented further than the dash.
            dashes = _DASHES.match(content)
            named_at = indent + (0 if dashes is None else dashes.end())
            unclosed = _Unclosed()
            # The quotation of the name itself ends with the name.
            unclosed.take(value.removeprefix('"'))
            is_first = _SAYS_SOMETHING.search(value) is None
    return "\n".join(lines)


class _Unclosed:
    """Tracks whether a value continues in the next line, by its brackets, double quotes and backslashes."""

    def __init__(self) -> None:
        self._depth = 0
        self._is_quoted = False
        self._goes_on = False
        self._lines = 0

    def take(self, text: str) -> None:
        """Take a line of the value."""
        self._lines += 1
        self._is_quoted ^= text.count('"') % 2 == 1
        self._depth += sum(map(text.count, "[({")) - sum(map(text.count, "])}"))
        self._goes_on = text.endswith("\\")

    def goes_on(self) -> bool:
        """Return whether the value continues; a bracket that is never closed must not remove the rest of a report."""
        return self._lines <= MAX_VALUE_LINES and (self._goes_on or self._is_quoted or self._depth > 0)


def _line(line: str) -> tuple[str, str | None]:
    """Return a line without secrets, and the (start of the) value of a secret that it names; None: it names none."""
    value = None
    named = _NAME.search(line)
    if named is not None:
        goes_on = _NAME_GOES_ON.match(line, named.end())
        end = named.end() if goes_on is None else goes_on.end()
        if _SAYS_SOMETHING.search(line, end) is None:
            value = line[end:] if _OPENS.search(line, end) is not None else None
        else:
            value = line[end:]
            line = f"{line[:end]} {LEFT_OUT}"
    line = _REFUSED_VALUE.sub(rf"\1 {LEFT_OUT}", line)
    if "://" in line and "@" in line:
        line = _NON_SPACE.sub(_without_user, _USER_AND_SPACE.sub(f"://{LEFT_OUT}@", line))
    line = _HEX_PAIRS.sub(LEFT_OUT, line)
    return _RUN.sub(_only_words, line), value


def _without_user(word: re.Match[str]) -> str:
    scheme, separator, rest = word[0].partition("://")
    _, at, host = rest.rpartition("@")
    return f"{scheme}://{LEFT_OUT}@{host}" if separator and at else word[0]


def _only_words(run: re.Match[str]) -> str:
    odd = 0
    for piece in _SEPARATORS.split(run[0]):
        if _PLAIN.fullmatch(piece) is None:
            odd += len(piece) if len(piece) <= _SHORT else _MAX_ODD + 1
    return run[0] if odd <= _MAX_ODD else LEFT_OUT


def scrubbed_value(value: Any) -> Any:
    """Return a value of YAML or JSON without anything that is or is called a secret."""
    if isinstance(value, dict):
        return {scrubbed(str(key)): _under(str(key), inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [scrubbed_value(inner) for inner in value]
    return scrubbed(value) if isinstance(value, str) else value


def _under(key: str, value: Any) -> Any:
    if value is not None and not isinstance(value, bool) and _NAME.search(f"{key}:") is not None:
        return LEFT_OUT
    return scrubbed_value(value)
