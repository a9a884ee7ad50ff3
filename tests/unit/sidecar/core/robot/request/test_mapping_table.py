from __future__ import annotations

from plr.protos.model.ids import InterfaceName, NodeName, Version
from plr.protos.model.mapping import Assignment, MappingSet, ServiceMapping
from plr.sidecar.core.base.values import PathId, PathState
from plr.sidecar.core.robot.request.mapping_table import MappingTable
from plr.sidecar.core.transfer.routes import Routes
from tests.support.builders import ECHO, WLAN, WWAN, A, B, path

WLAN_A, WLAN_B, WWAN_A, WWAN_B = path(WLAN, A), path(WLAN, B), path(WWAN, A), path(WWAN, B)
UP, UNSTABLE, DOWN = PathState.UP, PathState.UNSTABLE, PathState.DOWN
BOTH = (A, B)


def table(*pairs: tuple[str, str], **states: PathState) -> MappingTable:
    """All four paths are up unless `states` says otherwise; wlan0 and cloud-a are the faster ones."""
    routes = Routes()
    for rtt_ms, (name, known) in enumerate(
        {"wlan_a": WLAN_A, "wlan_b": WLAN_B, "wwan_a": WWAN_A, "wwan_b": WWAN_B}.items(), 10
    ):
        routes.set_state(known, states.get(name, UP))
        routes.set_rtt(known, rtt_ms / 1e3)
    mapping = MappingTable(routes)
    if pairs:
        assert apply(mapping, *pairs) is None
    return mapping


def apply(mapping: MappingTable, *pairs: tuple[str, str], version: int = 1) -> str | None:
    assignments = tuple(Assignment(InterfaceName(interface), NodeName(server)) for interface, server in pairs)
    mapping_set = MappingSet(Version(version), 1, (ServiceMapping(ECHO, assignments),))
    return mapping.apply(mapping_set, {WLAN, WWAN}, BOTH)


def test_a_pair_to_explore_has_to_be_there_as_mapped_ones_have() -> None:
    mapping = table(*MAPPED)
    for explore, error in (
        (Assignment(WLAN, A), None),
        (Assignment(InterfaceName("usb0"), A), "no interface 'usb0'"),
        (Assignment(WLAN, NodeName("elsewhere")), "no peer 'elsewhere'"),
    ):
        found = ServiceMapping(ECHO, (Assignment(WLAN, B),), explore=explore)
        problem = mapping.apply(MappingSet(Version(2), 1, (found,)), {WLAN, WWAN}, BOTH)
        assert problem is None if error is None else error in (problem or "")


def choose(
    mapping: MappingTable, servers: tuple[NodeName, ...] = BOTH, *, idempotent: bool = True
) -> tuple[PathId, ...]:
    return mapping.choose(ECHO, servers, idempotent=idempotent)


MAPPED = ((WLAN, B), (WWAN, A))


def test_mapped_paths_that_are_up_are_taken_as_they_are() -> None:
    assert choose(table(*MAPPED)) == (WLAN_B, WWAN_A)
    assert choose(table((WLAN, B))) == (WLAN_B,)


def test_an_unstable_mapped_path_is_kept_beside_one_that_is_up() -> None:
    assert choose(table(*MAPPED, wlan_b=UNSTABLE)) == (WLAN_B, WWAN_A)


def test_when_no_mapped_path_is_up_others_are_added() -> None:
    assert choose(table((WLAN, B), wlan_b=UNSTABLE)) == (WLAN_B, WLAN_A, WWAN_B)


def test_where_the_mapped_path_is_down_its_interface_takes_another_server() -> None:
    assert choose(table(*MAPPED, wlan_b=DOWN)) == (WLAN_A, WWAN_A)


def test_where_the_mapped_server_is_gone_its_interface_takes_another_one() -> None:
    assert choose(table(*MAPPED), servers=(A,)) == (WLAN_A, WWAN_A)


def test_an_interface_that_reaches_nobody_is_left_out() -> None:
    assert choose(table(*MAPPED, wlan_a=DOWN, wlan_b=DOWN)) == (WWAN_A,)


def test_without_a_mapping_each_interface_takes_a_server_of_its_own() -> None:
    assert choose(table()) == (WLAN_A, WWAN_B)
    assert choose(table(), servers=(A,)) == (WLAN_A, WWAN_A)


def test_nothing_reachable_nothing_chosen() -> None:
    down = dict.fromkeys(("wlan_a", "wlan_b", "wwan_a", "wwan_b"), DOWN)
    for mapping in (table(**down), table(*MAPPED, **down)):
        assert choose(mapping) == ()
        assert choose(mapping, idempotent=False) == ()
        assert mapping.rescue(BOTH) is None
    assert choose(table(), servers=()) == ()


def test_not_idempotent_goes_to_one_server_preferably_over_a_path_that_is_up() -> None:
    assert choose(table(*MAPPED, wwan_b=DOWN), idempotent=False) == (WLAN_B,)
    assert choose(table(*MAPPED, wlan_b=UNSTABLE), idempotent=False) == (WLAN_A, WWAN_A)
    assert choose(table((WLAN, A), (WWAN, A)), idempotent=False) == (WLAN_A, WWAN_A)


def test_not_idempotent_reaches_its_server_over_every_interface_that_would_carry_a_copy() -> None:
    assert choose(table(), idempotent=False) == (WLAN_A, WWAN_A)
    assert choose(table(*MAPPED), idempotent=False) == (WLAN_B, WWAN_B)
    assert choose(table((WLAN, B)), idempotent=False) == (WLAN_B,), "the mapping leaves the other one out"


def test_only_a_path_that_is_up_rescues() -> None:
    assert table().rescue(BOTH) == WLAN_A
    assert table(wlan_a=UNSTABLE).rescue((A,)) == WWAN_A
    assert table(wlan_a=UNSTABLE, wwan_a=DOWN).rescue((A,)) is None


def test_a_mapping_that_names_the_unknown_is_refused_and_the_old_one_stays() -> None:
    mapping = table(*MAPPED)
    for pair in (("eth9", A), (WLAN, "nobody")):
        error = apply(mapping, (WLAN, A), pair, version=9)
        assert error is not None
        assert {"eth9", "nobody"} & set(error.replace("'", " ").split())
    assert mapping.version == 1
    assert choose(mapping) == (WLAN_B, WWAN_A)
