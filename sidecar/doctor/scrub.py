"""Takes secrets out of text that leaves a node. Pure.

Nothing that holds secrets is collected in the first place, and of a configuration only what is known; this is for free
text: a passphrase on a command line in the journal, a key in an error. It leaves out too much rather than too little:
the rest of a line after a word such as password, and whatever long string consists of more than words and numbers.
Time grows with the text's length, whatever is in it.
"""

from __future__ import annotations

import re
from typing import Any

LEFT_OUT = "(left out)"
MAX_LINE = 2000
"""Characters: no line that helps is longer."""

_PEM = re.compile(r"-----BEGIN ([A-Z0-9 ]*)-----.*?(?:-----END \1-----|\Z)", re.DOTALL)
_NAME = re.compile(
    r"(?i)pass(?:phrase|word|wd|code)|secret|token|credential|authorization|cookie|bearer|api[-_ ]?key"
    r"|(?<![a-z])(?:pwd|psk)(?![a-z])|-pass(?![a-z])|(?<![a-z])(?:pass|keys?)(?=\"?'?\s*[=:])"
)
"""What is called so is a secret, and may consist of several words; [a-z] is either case here."""
_NAME_GOES_ON = re.compile(r"[\w.-]*")
_OPENS = re.compile(r"[=:>|\[{(\\]")
_SAYS_SOMETHING = re.compile(r"[^\W_]")
_REFUSED_VALUE = re.compile(r"\b(got) ['\"\[{].*")
"""In the error of a configuration: the value may be a secret that stands at the wrong key."""
_NON_SPACE = re.compile(r"\S+")
_HEX_PAIRS = re.compile(r"(?:[0-9A-Fa-f]{2}:){15,}[0-9A-Fa-f]{2}")
"""A fingerprint or a key: longer than any address."""
_RUN = re.compile(r"[A-Za-z0-9+/_=-]{20,}")
"""What keys and tokens are written in, as are paths and names."""
_SEPARATORS = re.compile(r"[+/_=-]+")
_PLAIN = re.compile(
    r"[a-z]{0,24}\d{0,4}|[A-Z]{1,24}\d{0,4}|[a-z]{0,24}(?:[A-Z][a-z]{1,23}){0,8}\d{0,4}|\d{1,20}|\d{8}T\d{6}Z?"
)
"""A piece of a path or a name: a word, several ones in camel case, a number, a time."""
_SHORT = 5
_MAX_ODD = 8
"""Characters of short pieces that are no words: A1, x86."""


def scrubbed(text: str) -> str:
    """Return the text, with lines of MAX_LINE characters at most, without what is, or is called, a secret."""
    text = _PEM.sub(lambda found: f"({found[1].strip() or 'PEM'} left out)", text)
    lines = []
    named_at = -1
    """Where the name of a secret begins whose value comes in lines below it; -1: of none."""
    is_first = False
    for line in text.split("\n"):
        content = line.lstrip()
        if not content:
            lines.append("")
            continue
        indent = len(line) - len(content)
        if named_at >= 0:
            # The first line is the value, wherever it stands; further ones where they stand in it or in a list.
            if is_first or indent > named_at or (indent == named_at and content.startswith("-")):
                is_first = False
                lines.append(f"{line[: min(indent, MAX_LINE)]}{LEFT_OUT}")
                continue
            named_at = -1
        shown, is_open = _line(line)
        lines.append(shown)
        if is_open:
            named_at, is_first = indent, True
    return "\n".join(lines)


def _line(line: str) -> tuple[str, bool]:
    """Return a line without secrets, and whether it ends with the name of one whose value comes in the next."""
    if len(line) > MAX_LINE:
        line = f"{line[:MAX_LINE]}..."
    is_open = False
    named = _NAME.search(line)
    if named is not None:
        goes_on = _NAME_GOES_ON.match(line, named.end())
        end = named.end() if goes_on is None else goes_on.end()
        if _SAYS_SOMETHING.search(line, end) is None:
            is_open = _OPENS.search(line, end) is not None
        else:
            line = f"{line[:end]} {LEFT_OUT}"
    line = _REFUSED_VALUE.sub(rf"\1 {LEFT_OUT}", line)
    if "://" in line and "@" in line:
        line = _NON_SPACE.sub(_without_user, line)
    line = _HEX_PAIRS.sub(LEFT_OUT, line)
    return _RUN.sub(_only_words, line), is_open


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
    """Return a value of YAML or JSON without what is, or is called, a secret, whatever stands there."""
    if isinstance(value, dict):
        return {scrubbed(str(key)): _under(str(key), inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [scrubbed_value(inner) for inner in value]
    return scrubbed(value) if isinstance(value, str) else value


def _under(key: str, value: Any) -> Any:
    if value is not None and not isinstance(value, bool) and _NAME.search(f"{key}:") is not None:
        return LEFT_OUT
    return scrubbed_value(value)
