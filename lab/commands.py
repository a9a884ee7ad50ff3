"""The words that change a running lab: one line, one change; and the links' first state on the command line.

    wlan0 delay_ms=20 loss=0.01        both directions of the link behind wlan0
    wlan0.down rate_kbps=5000          internet to host only; .up: host to internet
    wlan0 rate_kbps=none               unlimited again
    wlan0 outage | blackhole | unplug | restore | reset
    wlan0 down | up                    ip link set wlan0 down / up
    wwan0 rebind                       the NAT router forgets its mappings

With several robots, the host goes first: robot_2/wlan0 loss=0.1
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

from lab.errors import LabConfigError
from lab.profile import LinkProfile

if TYPE_CHECKING:
    from lab.lab import Lab

_VERBS = ("outage", "blackhole", "unplug", "restore", "reset", "down", "up", "rebind")
_PROFILE_FIELDS = tuple(field.name for field in fields(LinkProfile))


@dataclass(frozen=True, slots=True)
class Command:
    """A parsed line, with either `verb` or `changes` (of LinkProfile fields) set."""

    interface: str
    host: str | None = None
    direction: str | None = None
    """`up`, `down`, or None for both."""
    verb: str | None = None
    changes: tuple[tuple[str, float | int | None], ...] = ()


def parse_command(line: str) -> Command:
    """Parse one line.

    Raises:
        LabConfigError: the line is no command, or a value is out of range; the text says what was expected.
    """
    target, *words = line.replace(":", " ", 1).replace(",", " ").split() or [""]
    host, slash, interface = target.rpartition("/")
    interface, dot, direction = interface.partition(".")
    if not interface or not words or (slash and not host) or (dot and direction not in ("up", "down")):
        raise LabConfigError(f"expected INTERFACE[.up|.down] and what to do with it, got {line.strip()!r}")
    named = Command(interface, host or None, direction or None)
    if len(words) == 1 and words[0] in _VERBS:
        if direction:
            raise LabConfigError(f"{words[0]}: always for both directions")
        return replace(named, verb=words[0])
    changes = tuple(_parse_change(word) for word in words)
    LinkProfile.from_json(dict(changes))  # for its checks
    return replace(named, changes=changes)


def apply_command(lab: Lab, command: Command) -> None:
    """Carry out a command.

    Raises:
        LabError: no such link, host or router, or it died.
        LabConfigError: a value is out of range.
    """
    interface, host = command.interface, command.host
    if command.verb == "rebind":
        lab.nat(interface, host=host).rebind()
        return
    link = lab.link(interface, host=host)
    if command.verb == "down":
        lab.host(link.host).link_down(interface)
    elif command.verb == "up":
        lab.host(link.host).link_up(interface)
    elif command.verb is not None:
        getattr(link, command.verb)()
    elif command.direction is None:
        link.change(**dict(command.changes))
    else:
        profile = getattr(link.stats(), command.direction).profile
        link.set(**{command.direction: replace(profile, **dict(command.changes))})


def _parse_change(word: str) -> tuple[str, float | int | None]:
    name, equals, value = word.partition("=")
    if not equals or name not in _PROFILE_FIELDS:
        raise LabConfigError(f"expected one of {', '.join(_VERBS)}, or {'=, '.join(_PROFILE_FIELDS)}=; got {word!r}")
    if name == "rate_kbps" and value == "none":
        return name, None
    try:
        return name, int(value) if name == "queue_bytes" else float(value)
    except ValueError:
        raise LabConfigError(f"{name}: expected a number, got {value!r}") from None
