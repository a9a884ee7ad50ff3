from __future__ import annotations

from dataclasses import replace

import pytest

from plr.protos.model.ids import ServiceName
from plr.sidecar.core.rules.service_rule import MAX_FOUND, FallbackRule, Rules
from tests.support.builders import rule

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
    found = Rules(RULES).find(ServiceName(name))
    assert (found.pattern if found else None) == pattern


def test_matching_is_case_sensitive() -> None:
    assert Rules((rule("/Arm*"),)).find(ServiceName("/arm")) is None


def test_a_fallback_is_not_carried_whatever_glob_matches_it() -> None:
    local = ServiceName("/arm/plan_locally")
    assert Rules(RULES).find(local) is not None
    backed = replace(rule("/arm/plan"), fallback=FallbackRule(local))
    assert Rules((rule("/arm/*"), backed)).find(local) is None
    assert Rules((rule("/arm/*"), backed)).find(ServiceName("/arm/move")) is not None


def test_the_order_decides_between_a_name_and_a_glob() -> None:
    glob, name = rule("/arm/*", lifetime_s=1.0), rule("/arm/plan", lifetime_s=2.0)
    assert Rules((glob, name)).find(ServiceName("/arm/plan")) is glob
    assert Rules((name, glob)).find(ServiceName("/arm/plan")) is name


def test_invented_names_hold_no_memory() -> None:
    rules = Rules(RULES)
    for number in range(2 * MAX_FOUND):
        assert rules.find(ServiceName(f"/invented/{number}")) is RULES[3]
    assert len(rules._found) <= MAX_FOUND
