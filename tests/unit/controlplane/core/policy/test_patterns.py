"""Which names a pattern matches, and which patterns match no name at all."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from plr.controlplane.core.policy.patterns import NameKind, can_match, matches
from plr.protos.base.errors import DecodeError
from plr.protos.model.names import interface_name, node_name, service_name

CHECKS = {NameKind.NODE: node_name, NameKind.SERVICE: service_name, NameKind.INTERFACE: interface_name}
NAMES = {
    NameKind.NODE: st.from_regex(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,20}", fullmatch=True),
    NameKind.INTERFACE: st.from_regex(r"[!-.0-~]{1,15}", fullmatch=True),
    NameKind.SERVICE: st.from_regex(r"(/[A-Za-z_][A-Za-z0-9_]{0,6}){1,3}", fullmatch=True),
}


@pytest.mark.parametrize(
    ("name", "patterns", "expected"),
    [
        ("arm-1", ("arm-1",), True),
        ("arm-1", ("arm-?",), True),
        ("arm-10", ("arm-?",), False),
        ("arm-1", ("base-*", "arm-*"), True),
        ("Arm-1", ("arm-*",), False),
        ("/arm/grip/open", ("/arm/*",), True),
        ("/arm", ("/arm/*",), False),
        ("/plan_b", ("/plan_[ab]",), True),
        ("/plan_b", ("/plan_[!ab]",), False),
        ("a|b", ("a", "b"), False),
        ("arm-1\n", ("arm-1",), False),
        ("a.b", ("a?b",), True),
        ("axb", ("a.b",), False),
    ],
)
def test_matching(name: str, patterns: tuple[str, ...], expected: bool) -> None:
    assert matches(name, patterns) is expected


@pytest.mark.parametrize(
    ("kind", "pattern", "expected"),
    [
        (NameKind.NODE, "*", True),
        (NameKind.NODE, "arm-*", True),
        (NameKind.NODE, "", False),
        (NameKind.NODE, "arm 1", False),
        (NameKind.NODE, "-*", False),
        (NameKind.NODE, "[!a-zA-Z0-9]", False),
        (NameKind.NODE, "a[ /]b", False),
        (NameKind.NODE, "a[", False),
        (NameKind.NODE, "a[]_]", True),
        (NameKind.NODE, "/arm", False),
        (NameKind.INTERFACE, "wwan*", True),
        (NameKind.INTERFACE, "wlan0/1", False),
        (NameKind.INTERFACE, "wlan 0", False),
        (NameKind.SERVICE, "*", True),
        (NameKind.SERVICE, "/plan", True),
        (NameKind.SERVICE, "plan", False),
        (NameKind.SERVICE, "*plan", True),
        (NameKind.SERVICE, "?plan", True),
        (NameKind.SERVICE, "/plan/", False),
        (NameKind.SERVICE, "/plan/*", True),
        (NameKind.SERVICE, "//*", False),
        (NameKind.SERVICE, "/1*", False),
        (NameKind.SERVICE, "/plan-*", False),
    ],
)
def test_a_pattern_that_matches_no_name_is_known(kind: NameKind, pattern: str, expected: bool) -> None:
    assert can_match(pattern, kind) is expected


def pieces_for(character: str) -> list[str]:
    """Patterns that match it. A bare bracket might open a set."""
    return [*(() if character == "[" else (character,)), "?", "*", f"[{character}z]"]


@given(st.sampled_from(NameKind), st.data())
def test_what_matches_some_name_is_never_refused(kind: NameKind, data: st.DataObject) -> None:
    name = data.draw(NAMES[kind])
    pattern = "".join(data.draw(st.sampled_from(pieces_for(character))) for character in name)
    assert matches(name, (pattern,))
    assert can_match(pattern, kind)


@given(st.sampled_from(NameKind), st.text("ab/_-.*?[]!1", max_size=8), st.text("ab/_-.1", max_size=4))
def test_what_is_refused_matches_no_name(kind: NameKind, pattern: str, name: str) -> None:
    try:
        CHECKS[kind](name, "name")
    except DecodeError:
        return
    if matches(name, (pattern,)):
        assert can_match(pattern, kind)
