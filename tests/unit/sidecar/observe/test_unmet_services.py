"""A configured name that nobody serves is reported once, with the name that was probably meant."""

from __future__ import annotations

import pytest

from plr.protos.model.ids import ServiceName
from plr.sidecar.observe.unmet_services import (
    GRACE_S,
    MAX_NAMES_SHOWN,
    UnmetServices,
    told,
    told_mismatched,
    told_unreached,
)

pytestmark = pytest.mark.audit("ops-5")

PLAN, WHERE = ServiceName("/plan"), ServiceName("/where_i_am")


def test_a_name_that_was_never_served_is_reported_once_after_the_start() -> None:
    unmet = UnmetServices([PLAN, WHERE, "/arm/*"], 100.0)
    assert unmet.look(set(), {}, 100.0 + GRACE_S / 2) == []
    assert unmet.unmet == frozenset()
    assert unmet.look({PLAN}, {}, 100.0 + GRACE_S) == [WHERE]
    assert unmet.unmet == {WHERE}
    assert unmet.look({PLAN}, {}, 200.0) == []
    assert unmet.look({WHERE}, {}, 300.0) == [], "what is withdrawn is reported by who withdraws it"
    assert unmet.unmet == {PLAN}


def test_a_name_that_was_served_and_went_before_the_first_judgement_is_not_wrong() -> None:
    unmet = UnmetServices([PLAN], 0.0)
    unmet.look({PLAN}, {}, 1.0)
    assert unmet.look(set(), {}, GRACE_S) == []
    assert unmet.unmet == {PLAN}


def test_what_known_servers_offer_is_not_unmet_though_none_is_reached() -> None:
    unmet = UnmetServices([PLAN, WHERE], 0.0)
    unmet.look({WHERE}, {PLAN: 2, ServiceName("/of_a_glob"): 1}, GRACE_S / 2)
    assert unmet.unreached == {}
    assert unmet.look(set(), {PLAN: 2, ServiceName("/of_a_glob"): 1}, GRACE_S) == [PLAN]
    assert unmet.unmet == {WHERE}
    assert unmet.unreached == {PLAN: 2}
    assert told_unreached(PLAN, 2) == (
        "service /plan is offered by 2 servers that this robot knows, but it reaches none of them"
    )
    unmet.look({PLAN}, {WHERE: 1}, 30.0)
    assert unmet.unmet == frozenset()
    assert unmet.unreached == {WHERE: 1}


def test_what_came_a_moment_ago_is_not_blamed() -> None:
    unmet = UnmetServices([PLAN, WHERE], 0.0)
    unmet.look(set(), {}, GRACE_S - 1.0, [PLAN])
    assert unmet.look(set(), {WHERE: 1}, GRACE_S + 1.0, [PLAN, WHERE]) == [PLAN]
    assert unmet.look({PLAN}, {}, GRACE_S + 3.0, [PLAN, WHERE]) == [WHERE], "it lasts"


def test_a_server_whose_qos_does_not_fit_is_told_with_its_cure() -> None:
    assert told_mismatched(PLAN) == (
        "service /plan is served by a node of this host's ROS domain, with an incompatible QoS: make it reliable, "
        "which is the default"
    )


def test_the_line_names_what_was_probably_meant_or_what_there_is() -> None:
    whose = "no server that this robot knows"
    start = f"service /where_i_am is configured, but {whose} offers it"
    assert told(WHERE, ["/plan", "/where_am_i"], whose) == f"{start}; did you mean /where_am_i?"
    assert told(WHERE, [], whose) == f"{start}; offered: nothing"
    assert told(WHERE, ["/b", "/a", "/a"], whose) == f"{start}; offered: /a /b"
    many = [f"/s{number:02}" for number in range(MAX_NAMES_SHOWN + 3)]
    assert told(WHERE, many, whose).endswith("/s08 /s09 and 3 more")


def test_a_name_that_is_offered_is_not_called_wrong() -> None:
    """As on a robot with an expired certificate, which knows its servers from the disk."""
    assert told(WHERE, ["/plan", WHERE], "no server that this robot knows") == (
        f"service {WHERE} is configured and offered, but no server of it is reached, or none has the wanted type"
    )
