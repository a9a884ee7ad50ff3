from __future__ import annotations

from typing import Any

import pytest

from plr.protos.model.ids import InterfaceName, ServiceName
from plr.protos.model.members import AT_MOST_EVERY_INTERFACE, EVERY_INTERFACE, Copies, InterfaceLabel
from plr.protos.model.redundancy_mode import RedundancyMode
from plr.sidecar.core.base.values import Priority
from plr.sidecar.core.rules.budget import Budget
from plr.sidecar.core.rules.service_rule import FallbackRule
from tests.unit.sidecar.configs import CLOUD, ROBOT, SAFE, parse, with_service


@pytest.mark.parametrize(
    ("keys", "deadline_s", "lifetime_s"),
    [
        ({"deadline_ms": 100}, 0.1, 10.0),
        ({"deadline_ms": 5000}, 5.0, 50.0),
        ({"deadline_ms": 0.5, "lifetime_ms": 1}, 0.0005, 0.001),
        ({"deadline_ms": 60_000}, 60.0, 300.0),
        ({"deadline_ms": 60_000, "lifetime_ms": 300_000}, 60.0, 300.0),
    ],
)
def test_rules_of_a_robot(keys: dict[str, float], deadline_s: float, lifetime_s: float) -> None:
    (rule,) = parse(with_service(ROBOT, **keys, idempotent=True, drop_late=True)).service_rules()
    assert rule.pattern == "/plan_path"
    assert rule.deadline_s == pytest.approx(deadline_s)
    assert rule.lifetime_s == pytest.approx(lifetime_s)
    assert rule.idempotent
    assert rule.drop_late


@pytest.mark.audit("dp-13")
@pytest.mark.parametrize(("deadline_ms", "lifetime_s"), [(100, 30.0), (3500, 35.0), (60_000, 300.0)])
def test_late_answers_are_waited_for_longer_where_they_are_wanted(deadline_ms: float, lifetime_s: float) -> None:
    (rule,) = parse(with_service(ROBOT, deadline_ms=deadline_ms)).service_rules()
    assert rule.lifetime_s == pytest.approx(lifetime_s)


def test_copies_to_several_servers_only_when_asked_for() -> None:
    (rule,) = parse(ROBOT).service_rules()
    assert not rule.idempotent
    assert not rule.drop_late
    assert rule.priority is Priority.NORMAL


def test_a_key_of_a_service_without_a_value_is_as_if_left_out() -> None:
    empty = dict.fromkeys(("type", "idempotent", "priority", "hedge_quantile", "fallback_start", "cost_per_request"))
    assert parse(with_service(ROBOT, **empty)) == parse(ROBOT)
    assert parse(with_service(CLOUD, **empty)) == parse(CLOUD)


def test_a_fallback_and_when_it_is_asked() -> None:
    assert parse(ROBOT).service_rules()[0].fallback is None
    (rule,) = parse(with_service(ROBOT, **SAFE, fallback="/local")).service_rules()
    assert rule.fallback == FallbackRule(ServiceName("/local"), in_time=True, takes_s=None)
    (rule,) = parse(with_service(ROBOT, **SAFE, fallback="/local", fallback_takes_ms=20)).service_rules()
    assert rule.fallback == FallbackRule(ServiceName("/local"), in_time=True, takes_s=0.02)
    (rule,) = parse(with_service(ROBOT, **SAFE, fallback="/local", fallback_start="on_miss")).service_rules()
    assert rule.fallback == FallbackRule(ServiceName("/local"), in_time=False)


def test_how_many_copies_are_sent_and_when() -> None:
    (rule,) = parse(ROBOT).service_rules()
    assert (rule.redundancy, rule.hedge_quantile) == (RedundancyMode.REPLICATE, 0.95)
    changed = with_service(ROBOT, idempotent=True, redundancy="hedge", hedge_quantile=0.9)
    (rule,) = parse(changed).service_rules()
    assert (rule.redundancy, rule.hedge_quantile) == (RedundancyMode.HEDGE, 0.9)
    assert rule.adaptive_target == 0.001
    (rule,) = parse(with_service(ROBOT, redundancy="share", repeats=1)).service_rules()
    assert (rule.redundancy, rule.repeats) == (RedundancyMode.SHARE, 1.0)
    changed = with_service(ROBOT, idempotent=True, redundancy="adaptive", target_miss=0.01)
    (rule,) = parse(changed).service_rules()
    assert (rule.redundancy, rule.adaptive_target) == (RedundancyMode.ADAPTIVE, 0.01)
    assert (rule.copies, rule.target_miss) == (EVERY_INTERFACE, 0.0), "it says nothing of the mapping"
    assert rule.wanted_miss == 0.01


def test_what_extra_copies_may_cost() -> None:
    networks = [{"interface": "wwan0", "extra_load": 0.1, "extra_mb_per_day": 0.5}, {"interface": "*"}]
    assert parse(ROBOT, networks=networks).budgets() == (Budget("wwan0", 0.1, 500_000), Budget("*"))


def test_what_is_wanted_of_the_mapping() -> None:
    (rule,) = parse(ROBOT).service_rules()
    assert (rule.copies, rule.target_miss) == (EVERY_INTERFACE, 0.0)
    (rule,) = parse(with_service(ROBOT, copies="at_most")).service_rules()
    assert rule.copies == AT_MOST_EVERY_INTERFACE
    (rule,) = parse(with_service(ROBOT, mode="cheapest", target_miss=0.001)).service_rules()
    assert (rule.copies, rule.target_miss) == (AT_MOST_EVERY_INTERFACE, 0.001)
    (rule,) = parse(with_service(ROBOT, mode="cheapest", target_miss=0.001, copies=2)).service_rules()
    assert rule.copies == Copies(2, 2)
    assert parse(with_service(CLOUD, cost_per_request=2)).service_rules()[0].cost_per_request == 2.0


def test_the_first_network_that_matches_an_interface_labels_it() -> None:
    networks = [{"interface": "wwan0", "carrier": "telekom"}, {"interface": "ww*", "cost_per_request": 2}]
    config = parse(ROBOT, networks=networks)
    names = [InterfaceName(name) for name in ("wwan0", "wwan1", "wwan0", "wlan0")]
    assert config.labels(names) == (
        InterfaceLabel(InterfaceName("wwan0"), "telekom", 1.0),
        InterfaceLabel(InterfaceName("wwan1"), "", 2.0),
    )


def test_a_hundredth_of_the_requests_may_explore_unless_told_otherwise() -> None:
    assert parse(with_service(ROBOT, idempotent=True)).service_rules()[0].exploration == 0.01
    for share in (0, 0.1):
        (rule,) = parse(with_service(ROBOT, idempotent=True, exploration=share)).service_rules()
        assert rule.exploration == share


@pytest.mark.parametrize("priority", Priority)
def test_priorities_are_words(priority: Priority) -> None:
    (rule,) = parse(with_service(ROBOT, priority=priority.name.lower())).service_rules()
    assert rule.priority is priority


@pytest.mark.parametrize(
    ("written", "ratio"),
    [("auto", None), ("off", 0.0), (False, 0.0), (0, 0.0), (0.25, 0.25), (1, 1.0)],
)
@pytest.mark.parametrize("role", [ROBOT, CLOUD])
def test_repair_symbols_are_off_automatic_or_a_ratio(
    role: dict[str, Any], written: object, ratio: float | None
) -> None:
    (rule,) = parse(with_service(role, fec=written)).service_rules()
    assert rule.fec == ratio
    assert parse(role).service_rules()[0].fec is None
