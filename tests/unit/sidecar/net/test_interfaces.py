from __future__ import annotations

from dataclasses import replace

import pytest

from plr.protos.model.ids import InterfaceName
from plr.sidecar.core.seam.links import Rebind
from plr.sidecar.net.interfaces import (
    LOOPBACK,
    Interface,
    SkippedInterface,
    choose,
    list_interfaces,
    missing_interfaces,
)

WLAN = Interface(
    InterfaceName("wlan0"),
    3,
    "",
    up=True,
    carrier=True,
    mtu=1500,
    addresses=("192.0.2.2",),
    gateways=((4, "192.0.2.1"),),
)


NONE: frozenset[int] = frozenset()


def interface(name: str, kind: str = "") -> Interface:
    return replace(WLAN, name=InterfaceName(name), kind=kind)


LO = interface("lo", LOOPBACK)


def names(interfaces: tuple[Interface, ...]) -> list[str]:
    return [entry.name for entry in interfaces]


@pytest.mark.parametrize(
    "entry",
    [
        WLAN,
        interface("enp3s0"),
        interface("usb0"),
        interface("wwan0", "wwan"),
        interface("rmnet_data0", "rmnet"),
        interface("ppp0", "ppp"),
        interface("bond0", "bond"),
        interface("eth0.7", "vlan"),
    ],
)
def test_what_leads_out_of_the_machine_is_used_by_default(entry: Interface) -> None:
    assert choose([entry], None).usable == (entry,)


VIRTUAL = [
    LO,
    interface("docker0", "bridge"),
    interface("br-2f1c", "bridge"),
    interface("eth0", "veth"),
    interface("wlan0", "veth"),
    interface("wwan0", "tun"),
    interface("home", "wireguard"),
    interface("tailscale0", "tun"),
    interface("cni0", "bridge"),
    interface("flannel.1", "vxlan"),
    interface("virbr0", "bridge"),
    interface("ifb0", "ifb"),
    interface("dummy0", "dummy"),
    interface("macvlan0", "macvlan"),
    # No kind told: the name decides.
    interface("docker0"),
    interface("tun0"),
    interface("veth12ab"),
]


@pytest.mark.parametrize("entry", VIRTUAL)
def test_loopback_containers_and_tunnels_only_under_their_exact_name(entry: Interface) -> None:
    for wanted in (None, ["*"], [entry.name[:1] + "*"]):
        choice = choose([entry], wanted)
        assert choice.usable == ()
        assert "exact name" in choice.skipped[0].reason
    assert choose([entry], [entry.name]).usable == (entry,)
    assert choose([entry], ["*", entry.name]).usable == (entry,)


@pytest.mark.parametrize(
    ("entry", "reason"),
    [
        (replace(WLAN, up=False, carrier=False), "down"),
        (replace(WLAN, carrier=False), "no carrier"),
        (replace(WLAN, addresses=()), "no address"),
    ],
)
def test_what_cannot_carry_is_skipped_even_when_named(entry: Interface, reason: str) -> None:
    for wanted in (None, ["wlan0"], ["wl*"]):
        choice = choose([entry], wanted)
        assert choice.usable == ()
        assert choice.skipped == (SkippedInterface(entry.name, entry.index, reason, wanted=True),)
        assert choice.missing == ()


def test_a_list_leaves_out_the_rest() -> None:
    eth = interface("eth0")
    choice = choose([WLAN, eth, LO], ["eth*"])
    assert names(choice.usable) == ["eth0"]
    assert [skipped.reason for skipped in choice.skipped] == ["not in the configuration"] * 2
    assert not any(skipped.wanted for skipped in choice.skipped)


def test_a_named_interface_that_does_not_exist_is_missing_but_a_glob_may_match_nothing_yet() -> None:
    choice = choose([WLAN], ["wlan0", "wlan1", "wwan*"])
    assert choice.missing == ("wlan1",)
    assert names(choice.usable) == ["wlan0"]


def test_what_is_missing_is_told_to_people_with_what_there_is() -> None:
    (line,) = missing_interfaces([WLAN], ["wlan0", "wlan1", "wwan*"])
    assert line == "wlan1: there is no such interface now (there are: wlan0); it is used as soon as it appears"


@pytest.mark.audit("ops-1")
def test_what_is_said_of_interfaces_that_are_not_there_is_told_once() -> None:
    lines = missing_interfaces([WLAN], ["wlan0", "wwan0"], ["wlan*", "wwan0", "wwan1", "usb*"])
    assert lines == [
        "wwan0: there is no such interface now (there are: wlan0); it is used as soon as it appears",
        "networks: wwan1 matches no interface now (there are: wlan0)",
        "networks: usb* matches no interface now (there are: wlan0)",
    ]


def test_an_interface_without_default_route_is_usable() -> None:
    assert choose([replace(WLAN, gateways=())], None).usable


def test_this_host_has_a_loopback_interface() -> None:
    (loopback,) = [entry for entry in list_interfaces() if entry.kind == LOOPBACK]
    assert loopback.name == "lo"
    assert loopback.gateways == ()
    assert loopback.index == 1


@pytest.mark.parametrize(
    ("after", "rebound"),
    [
        (WLAN, None),
        (replace(WLAN, addresses=("192.0.2.3",)), Rebind(frozenset({"192.0.2.2"}), NONE)),
        (replace(WLAN, addresses=()), Rebind(frozenset({"192.0.2.2"}), NONE)),
        (replace(WLAN, addresses=("2001:db8::2", "192.0.2.2")), Rebind(frozenset(), NONE)),
        (replace(WLAN, gateways=((4, "192.0.2.9"),)), Rebind(frozenset(), frozenset({4}))),
        (replace(WLAN, gateways=()), Rebind(frozenset(), frozenset({4}))),
        (replace(WLAN, gateways=((4, "192.0.2.1"), (6, "fe80::1"))), Rebind(frozenset(), frozenset({6}))),
        (replace(WLAN, mtu=1280), None),
    ],
)
def test_a_lost_address_or_another_gateway_rebinds_what_uses_it(after: Interface, rebound: Rebind | None) -> None:
    assert after.rebound_since(WLAN) == rebound


def test_the_families_are_those_of_the_addresses() -> None:
    assert WLAN.families == {4}
    assert replace(WLAN, addresses=("2001:db8::2",)).families == {6}
    assert replace(WLAN, addresses=()).families == frozenset()
