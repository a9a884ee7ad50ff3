from __future__ import annotations

from dataclasses import replace

import pytest

from protos.model import ServiceName
from sidecar.core.fallback_rule import FallbackRule
from sidecar.core.rules import find_rule
from tests.unit.sidecar.core.builders import rule

RULES = (rule("/arm/plan"), rule("/arm/*"), rule("/node/get_parameters"), rule("/*"))


@pytest.mark.parametrize(
    ("name", "pattern"),
    [
        ("/arm/plan", "/arm/plan"),
        ("/arm/move", "/arm/*"),
        ("/other", "/*"),
        ("/node/get_parameters", "/node/get_parameters"),
        ("/arm/get_parameters", None),
        ("/arm/change_state", None),
        ("/arm/go/_action/send_goal", None),
        ("arm", None),
    ],
)
def test_the_first_match_wins_and_globs_open_no_parameters(name: str, pattern: str | None) -> None:
    found = find_rule(RULES, ServiceName(name))
    assert (found.pattern if found else None) == pattern


def test_matching_is_case_sensitive() -> None:
    assert find_rule((rule("/Arm*"),), ServiceName("/arm")) is None


def test_a_fallback_is_not_carried_whatever_glob_matches_it() -> None:
    local = ServiceName("/arm/plan_locally")
    assert find_rule(RULES, local) is not None
    backed = replace(rule("/arm/plan"), fallback=FallbackRule(local))
    assert find_rule((rule("/arm/*"), backed), local) is None
    assert find_rule((rule("/arm/*"), backed), ServiceName("/arm/move")) is not None
