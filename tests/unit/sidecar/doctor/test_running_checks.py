"""What a running sidecar's state says: whom to blame, and each check seen to pass and to fail."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from plr.sidecar.core.path.pmtu import LEAST_MTU
from plr.sidecar.doctor import running_checks
from plr.sidecar.doctor.finding import Finding, Level
from plr.sidecar.doctor.running_checks import Pinged

if TYPE_CHECKING:
    from collections.abc import Iterable

pytestmark = pytest.mark.audit("ops-14")

UP_S = 3600.0


def path(interface: str, peer: str, state: str = "up", **changes: Any) -> dict[str, Any]:
    return {
        "interface": interface, "peer": peer, "remote": 0, "address": ["192.0.2.1", 24700], "candidates": 1,
        "state": state, "since_s": 600.0, "reason": "answers" if state == "up" else "silent", "rtt_s": 0.02,
        "sent": 1000, "lost": 1, "recent": {"window_s": 50.0, "sent": 500, "lost": 1},
        "max_datagram": 1472, "proven_s": 0.2, "rests": False, **changes,
    }  # fmt: skip


def losing(interface: str, peer: str, lost: int = 50, **changes: Any) -> dict[str, Any]:
    return path(interface, peer, recent={"window_s": 50.0, "sent": 500, "lost": lost}, **changes)


def stun(**changes: Any) -> dict[str, Any]:
    return {"family": 4, "mapping": ["203.0.113.7", 5000], "server": ["192.0.2.9", 3478], "answered_s": 3.0,
            "changes": 0, "problem": "", **changes}  # fmt: skip


def interface(name: str, **changes: Any) -> dict[str, Any]:
    return {"name": name, "suspended": False, "addresses": ["10.0.0.2"], "port": 5000, "mtu": 1500,
            "bound_to": "device", "hangs": 0, "stun": [stun()], **changes}  # fmt: skip


def state(**changes: Any) -> dict[str, Any]:
    paths = [path(name, peer) for name in ("wlan0", "wwan0") for peer in ("cloud-a", "cloud-b")]
    return {
        "node": {"name": "robot-1", "role": "robot", "version": "1", "up_s": UP_S, "stun": True, "insecure": False},
        "interfaces": [interface("wlan0"), interface("wwan0")],
        "paths": paths,
        "services": {"carried": {"/plan": "nav_msgs/srv/GetPlan"}, "unmet": [], "left_alone": {}, "missing_types": {}},
        "mapping": {"version": 7, "source": "control plane", "age_s": 60.0},
        "mapped": [{"service": "/plan", "pairs": [{"interface": "wlan0", "server": "cloud-a"}],
                    "predicted_miss": 0.001, "reason": "", "deadline_s": 0.1}],
        "control": {"names": ["cp:50051"], "connected": True, "since_s": 5.0, "interface": "wlan0"},
        "gone": [],
        **changes,
    }  # fmt: skip


def texts(findings: Iterable[Finding], *levels: Level) -> list[str]:
    found = list(findings)
    assert all(finding.remedy for finding in found if finding.level is not Level.OK)
    return [finding.text for finding in found if finding.level in levels]


BAD = (Level.WARN, Level.FAIL)


def test_a_healthy_node_has_nothing_but_ok() -> None:
    healthy = state()
    checks = [
        running_checks.node(healthy, "robot-1"), running_checks.devices(healthy), running_checks.stun(healthy),
        running_checks.mtu(healthy), running_checks.paths(healthy, {}), running_checks.gone(healthy),
        running_checks.services(healthy), running_checks.mapping(healthy, lambda _: 0.01),
        running_checks.control(healthy),
    ]  # fmt: skip
    for check in checks:
        assert texts(check, *BAD) == []


def test_another_sidecar_and_one_without_certificates_are_told() -> None:
    assert "the configuration is for robot-9" in texts(running_checks.node(state(), "robot-9"), Level.FAIL)[0]
    insecure = state(node={**state()["node"], "insecure": True})
    assert len(texts(running_checks.node(insecure, "robot-1"), Level.WARN)) == 1
    refused = state(refused_peers=[{"name": "cloud-x", "why": "it is revoked"}])
    assert texts(running_checks.node(refused, "robot-1"), Level.WARN) == ["cloud-x is refused: it is revoked"]


def test_a_dark_interface_is_blamed_once() -> None:
    paths = [path("wlan0", "cloud-a"), path("wlan0", "cloud-b")]
    paths += [path("wwan0", peer, "down") for peer in ("cloud-a", "cloud-b")]
    (text,) = texts(running_checks.paths(state(paths=paths), {}), *BAD)
    assert text.startswith("wwan0: no peer is reached over it, but some are over others: silent for 10 min")


def test_a_dead_server_is_blamed_once_and_no_interface_with_it() -> None:
    paths = [path(name, "cloud-a") for name in ("wlan0", "wwan0")]
    paths += [path(name, "cloud-b", "down") for name in ("wlan0", "wwan0")]
    (text,) = texts(running_checks.paths(state(paths=paths), {}), *BAD)
    assert text.startswith("cloud-b: not reached over wlan0, wwan0")


def test_one_path_that_is_down_is_blamed_itself() -> None:
    paths = [path("wlan0", "cloud-a"), path("wlan0", "cloud-b"), path("wwan0", "cloud-a")]
    paths += [path("wwan0", "cloud-b", "down")]
    (text,) = texts(running_checks.paths(state(paths=paths), {}), *BAD)
    assert text == "wwan0 to cloud-b (192.0.2.1:24700): down for 10 min, silent"


def test_with_nothing_reached_it_fails_but_not_just_after_the_start() -> None:
    dark = [path(name, "cloud-a", "down", reason=None, since_s=None) for name in ("wlan0", "wwan0")]
    assert texts(running_checks.paths(state(paths=dark), {}), Level.FAIL) == [
        "no peer is reached over wlan0, wwan0: never answered"
    ]
    nowhere = [{**one, "candidates": 0, "address": None} for one in dark]
    (text,) = texts(running_checks.paths(state(paths=nowhere), {}), Level.FAIL)
    assert "cloud-a announced no address" in text
    young = state(paths=dark, node={**state()["node"], "up_s": 2.0})
    assert texts(running_checks.paths(young, {}), Level.FAIL) == []


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"control": {"names": ["cp:50051"], "connected": False, "last_failure": "connection refused"}},
         "no peer is known: the control plane cp:50051 is not reached (connection refused), and no peer is known"),
        ({"control": {"names": ["cp:50051"], "connected": True}},
         "no peer is known: the control plane names no cloud server to this node; none is registered, or the policy"),
        ({"refused_peers": [{"name": "cloud-a", "why": "it is revoked"}]}, "no peer is accepted: all that the control"),
    ],
)  # fmt: skip
def test_a_robot_without_a_peer_fails_and_says_why(changes: dict[str, Any], why: str) -> None:
    (text,) = texts(running_checks.paths(state(paths=[], **changes), {}), Level.FAIL)
    assert text.startswith(why)
    node = state()["node"]
    for other in ({**node, "up_s": 2.0}, {**node, "role": "cloud"}):
        (text,) = texts(running_checks.paths(state(paths=[], node=other, **changes), {}), *BAD)
        assert texts(running_checks.paths(state(paths=[], node=other, **changes), {}), Level.FAIL) == []


DORMANT = {"name": "cloud-c", "reason": "lease_expired", "since_s": 7200.0, "kept": "dormant", "dormant_s": 60.0}
OUT_OF_REACH = {"names": ["cp:50051"], "connected": False, "since_s": 7000.0, "last_failure": "timed out"}


@pytest.mark.parametrize("control", [OUT_OF_REACH, {"names": ["cp:50051"], "connected": True}])
def test_a_robot_whose_only_server_is_dormant_is_told_that_it_is_kept(control: dict[str, Any]) -> None:
    told = state(paths=[], control=control, removed_peers=[DORMANT], mapping={"version": 0}, services=UNMET)
    (finding,) = running_checks.paths(told, {})
    assert finding.level is Level.FAIL
    assert finding.text == (
        "no peer is reached; the control plane removed these, and this sidecar keeps them: cloud-c (removed 2 h ago: "
        "its lease expired, no path to it has been up for 60 s). It talks to each as soon as a path answers"
    )
    assert "Do not restart this sidecar" in finding.remedy
    assert ("see control below" in finding.remedy) is not control["connected"]
    services = texts(running_checks.services(told), Level.FAIL)
    assert services == [
        *(f"{name}: configured, but no cloud server is reached" for name in UNMET["unmet"]),
        "none is offered, because no peer is reached",
    ]
    young = {**told, "node": {**told["node"], "up_s": 2.0}}
    assert texts(running_checks.paths(young, {}), Level.FAIL) == []


def test_pings_are_shown_and_missed_ones_warned_of() -> None:
    key = ("wlan0", "cloud-a", 0)
    one = state(paths=[path("wlan0", "cloud-a")])
    (text,) = texts(running_checks.paths(one, {key: Pinged([0.01, 0.02], 3)}), Level.OK)
    assert text.endswith("ping 10.0 ms to 20.0 ms, 1 of 3 lost")
    (text,) = texts(running_checks.paths(one, {key: Pinged([], 3)}), Level.WARN)
    assert text.endswith("none of 3 pings was answered")


def test_a_lossy_or_unstable_path_is_warned_of() -> None:
    lossy = state(paths=[losing("wlan0", "cloud-a")])
    assert "10 % of 500 datagrams lost in the last 50 s" in texts(running_checks.paths(lossy, {}), Level.WARN)[0]
    unstable = state(paths=[path("wlan0", "cloud-a", "unstable")])
    assert "unstable" in texts(running_checks.paths(unstable, {}), Level.WARN)[0]


@pytest.mark.parametrize(
    ("of", "expected"),
    [
        ({"mapping": ["10.0.0.2", 5000]}, "no NAT"),
        ({"mapping": ["203.0.113.7", 5000]}, "a NAT that keeps the port"),
        ({"mapping": ["203.0.113.7", 5999]}, "a NAT that changes the port"),
        ({"changes": 4}, "mapping changed 4 times"),
    ],
)
def test_what_stun_says_of_the_nat(of: dict[str, Any], expected: str) -> None:
    (text,) = texts(running_checks.stun(state(interfaces=[interface("wlan0", stun=[stun(**of)])])), Level.OK)
    assert expected in text


def test_stun_servers_of_the_other_family_alone_are_told_from_none() -> None:
    none = state(interfaces=[interface("wlan0", stun=[], stun_families=[])])
    assert "no STUN server is known;" in f"{texts(running_checks.stun(none), Level.WARN)[0]};"
    other = state(interfaces=[interface("wlan0", addresses=["fd00:1::9"], stun=[], stun_families=[4])])
    (text,) = texts(running_checks.stun(other), Level.WARN)
    assert "no STUN server is known for the family of its addresses, only for IPv4" in text
    assert "resolved" not in text


def test_stun_that_is_not_answered_is_warned_of_unless_the_other_family_is() -> None:
    silent = stun(mapping=None, answered_s=None, problem="no answer from 192.0.2.9:3478")
    alone = state(interfaces=[interface("wlan0", stun=[silent])])
    (text,) = texts(running_checks.stun(alone), Level.WARN)
    assert text == "wlan0: no answer over IPv4: no answer from 192.0.2.9:3478"
    old = state(interfaces=[interface("wlan0", stun=[stun(answered_s=300.0)])])
    assert "the last answer came 5 min ago" in texts(running_checks.stun(old), Level.WARN)[0]
    both = state(interfaces=[interface("wlan0", stun=[stun(), {**silent, "family": 6}])])
    assert texts(running_checks.stun(both), *BAD) == []
    assert len(texts(running_checks.stun(state(interfaces=[interface("wlan0", stun=[])])), Level.WARN)) == 1


@pytest.mark.parametrize(
    ("servers", "expected"),
    [
        (["cp.example:3479", "[2001:db8::1]:3478"], "check 3479/udp of cp.example, 3478/udp of [2001:db8::1], a route"),
        ([f"stun-{number}:9000" for number in range(5)], "9000/udp of stun-2 and of 2 more, a route"),
        ([], "check the UDP port of the STUN servers, a route"),
    ],
)
def test_a_silent_stun_server_is_named_with_its_own_port(servers: list[str], expected: str) -> None:
    silent = interface("wlan0", stun=[stun(mapping=None, answered_s=None, problem="no answer")])
    told = state(interfaces=[silent], node={**state()["node"], "stun_servers": servers})
    assert expected in next(running_checks.stun(told)).remedy


def test_a_path_that_carries_the_least_only_is_warned_of() -> None:
    stuck = state(paths=[path("wlan0", "cloud-a", max_datagram=1200)])
    (text,) = texts(running_checks.mtu(stuck), Level.WARN)
    assert "takes 1500 bytes, but paths to cloud-a carry only the minimum" in text
    searching = state(paths=[path("wlan0", "cloud-a", max_datagram=1200, since_s=5.0)])
    assert texts(running_checks.mtu(searching), *BAD) == []


@pytest.mark.audit("ops-14")
def test_an_interface_that_takes_less_than_the_least_fails() -> None:
    small = state(interfaces=[{**interface("wlan0"), "mtu": LEAST_MTU - 1}, interface("wwan0")])
    (text,) = texts(running_checks.mtu(small), Level.FAIL)
    assert text == "wlan0: takes 1227 bytes, but larger requests need 1228 and do not get through"
    enough = state(interfaces=[{**interface("wlan0"), "mtu": LEAST_MTU}, interface("wwan0")])
    assert texts(running_checks.mtu(enough), *BAD) == []


def test_sockets_and_drivers() -> None:
    odd = state(interfaces=[interface("wlan0", bound_to="address", hangs=2)])
    assert len(texts(running_checks.devices(odd), Level.WARN)) == 2


def test_who_is_gone_is_told_until_it_is_back() -> None:
    left = {"interface": "wlan0", "peer": "cloud-c", "since_s": 30.0, "reason": "silent"}
    (text,) = texts(running_checks.gone(state(gone=[left])), Level.WARN)
    assert text.startswith("cloud-c: gone for 30 s: silent over wlan0")
    goodbye = {**left, "reason": "peer closed"}
    assert texts(running_checks.gone(state(gone=[goodbye])), *BAD) == []
    assert texts(running_checks.gone(state(gone=[{**left, "peer": "cloud-a"}])), Level.OK, *BAD) == []


def test_services() -> None:
    told = {"carried": {}, "unmet": ["/plan"], "left_alone": {"/map": ["/map_server"]}, "missing_types": {}}
    assert len(texts(running_checks.services(state(services=told)), Level.WARN)) == 3


UNMET = {"carried": {}, "unmet": ["/map", "/plan"]}
NO_CLOUD = "configured, but not offered by any cloud server that the control plane names to this robot"


@pytest.mark.parametrize(
    ("told", "expected"),
    [
        (UNMET, [f"/map: {NO_CLOUD}", f"/plan: {NO_CLOUD}", "none is offered: no server offers what is configured"]),
        ({**UNMET, "unmet": ["/plan"], "conflicts": [{"service": "/plan", "server": "cloud-a", "type": "a/srv/B"}]},
         ["/plan: cloud-a offers it as a/srv/B, unlike the configuration or the other servers, so it gets no requests "
          "there", "none is offered: no server offers what is configured"]),
        ({"carried": {}, "unreached": {"/plan": 2}},
         ["/plan: offered by 2 servers that this robot knows, but none of them is reached",
          "none is offered: no server of a configured service is reached"]),
        ({"carried": {}}, ["none is offered: no server that this robot knows offers a service that services names"]),
    ],
)  # fmt: skip
def test_a_robot_without_a_single_service_fails_and_says_why(told: dict[str, Any], expected: list[str]) -> None:
    assert texts(running_checks.services(state(services=told)), Level.FAIL) == expected
    young = state(services=told, node={**state()["node"], "up_s": 2.0})
    assert texts(running_checks.services(young), Level.FAIL) == []
    one_left = {**told, "carried": {"/other": "a/srv/B"}}
    assert texts(running_checks.services(state(services=one_left)), Level.FAIL) == []
    alone = texts(running_checks.services(state(services=told, paths=[])), Level.FAIL)
    assert alone[-1] == "none is offered, because no peer is known"
    assert not any("control plane names" in text for text in alone)


def test_a_cloud_that_offers_nothing_is_warned_only() -> None:
    cloud = {**state()["node"], "role": "cloud"}
    assert texts(running_checks.services(state(services=UNMET, node=cloud)), Level.FAIL) == []


def test_one_odd_server_of_a_service_that_others_serve_is_warned_of() -> None:
    told = {
        "carried": {"/plan": "a/srv/A"},
        "conflicts": [{"service": "/plan", "server": "cloud-b", "type": "a/srv/B"}],
    }
    (text,) = texts(running_checks.services(state(services=told)), *BAD)
    assert text.startswith("/plan: cloud-b offers it as a/srv/B, unlike")


def test_a_server_whose_qos_does_not_fit_blames_no_name() -> None:
    told = {"carried": {"/map": "nav_msgs/srv/GetMap"}, "unmet": [], "mismatched": ["/plan"]}
    (finding,) = [one for one in running_checks.services(state(services=told)) if one.level is Level.WARN]
    assert "with an incompatible QoS" in finding.text
    assert "reliable" in finding.remedy


def test_a_service_whose_servers_are_not_reached_is_not_told_as_a_wrong_name() -> None:
    told = {"carried": {"/map": "nav_msgs/srv/GetMap"}, "unmet": [], "unreached": {"/plan": 2}}
    (text,) = texts(running_checks.services(state(services=told)), Level.WARN)
    assert text.startswith("/plan: offered by 2 servers that this robot knows, but none of them is reached")


@pytest.mark.parametrize(
    ("environment", "where"),
    [
        ({"ROS_DOMAIN_ID": "7"}, "ROS domain, ROS_DOMAIN_ID 7"),
        ({}, "ROS domain, ROS_DOMAIN_ID 0"),
        ({"ROS_DOMAIN_ID": ""}, "ROS domain, ROS_DOMAIN_ID 0"),
        (None, "ROS domain"),  # a sidecar of an earlier version
    ],
)
def test_a_server_that_a_cloud_misses_may_be_in_another_domain(environment: object, where: str) -> None:
    node = {"name": "cloud-a", "role": "cloud", "environment": environment}
    told = {"carried": {"/map": "a/srv/B"}, "unmet": ["/plan"]}
    (found,) = [one for one in running_checks.services(state(node=node, services=told)) if one.level is Level.WARN]
    assert found.text == f"/plan: configured, but not offered by a node of this host's {where}"
    assert found.remedy == "compare the names (plr status), and the ROS_DOMAIN_ID that the server was started with"


def test_the_mapping() -> None:
    none = state(mapping={"version": 0, "source": None, "age_s": None}, mapped=[])
    (text,) = texts(running_checks.mapping(none, lambda _: None), Level.WARN)
    assert "this robot chooses paths by round-trip time" in text
    nothing: dict[str, object] = {"carried": {}, "unmet": [], "left_alone": {}, "missing_types": {}}
    idle = state(mapping={"version": 0, "source": None, "age_s": None}, mapped=[], services=nothing)
    assert "no service is offered yet" in texts(running_checks.mapping(idle, lambda _: None), Level.WARN)[0]
    disk = state(mapping={"version": 7, "source": "disk", "age_s": 9.0})
    assert "kept on disk" in texts(running_checks.mapping(disk, lambda _: None), Level.WARN)[0]
    assert "more than its target 0.01 %" in texts(running_checks.mapping(state(), lambda _: 1e-4), Level.WARN)[0]
    paths = [path("wlan0", "cloud-a", "down"), path("wwan0", "cloud-b")]
    (text,) = texts(running_checks.mapping(state(paths=paths), lambda _: None), Level.WARN)
    assert "wlan0 to cloud-a is down" in text


def ways(*paths: tuple[str, str]) -> dict[str, Any]:
    return {"service": "/plan", "paths": [{"interface": name, "server": server} for name, server in paths]}


LIVE = "requests go over these live paths: wlan0 to cloud-a, wwan0 to cloud-b"


@pytest.mark.parametrize("version", [0, 7])
@pytest.mark.parametrize("reason", [None, "no live server offers it as nav_msgs/srv/GetPlan"])
def test_without_a_mapping_the_live_paths_are_told(version: int, reason: str | None) -> None:
    (mapped,) = state()["mapped"]
    empty = [] if reason is None else [{**mapped, "pairs": [], "predicted_miss": 1.0, "reason": reason}]
    live = [ways(("wlan0", "cloud-a"), ("wwan0", "cloud-b"))]
    told = state(mapped=empty, ways=live, mapping={"version": version, "source": "control plane", "age_s": 1.0})
    found = texts(running_checks.mapping(told, lambda _: 0.01), *BAD)
    assert f"/plan: no mapping from the control plane ({reason or 'not sent yet'}); {LIVE}" in found
    assert not any("predicted" in text or "no path" in text for text in found)
    assert texts(running_checks.mapping(told, lambda _: 0.01), Level.FAIL) == []


def test_what_replaces_a_mapped_path_that_is_down_is_told() -> None:
    paths = [path("wlan0", "cloud-a", "down"), path("wwan0", "cloud-b")]
    told = state(paths=paths, ways=[ways(("wwan0", "cloud-b"))])
    (text,) = texts(running_checks.mapping(told, lambda _: None), Level.WARN)
    assert text.endswith("wlan0 to cloud-a is down; requests go over these live paths: wwan0 to cloud-b")
    (text,) = texts(running_checks.mapping({**told, "ways": [ways()]}, lambda _: None), Level.FAIL)
    assert text.endswith("no other path to a server of it is up")


@pytest.mark.audit("ops-14")
def test_a_mapping_that_leads_nowhere_fails_and_a_hopeless_one_is_warned_of() -> None:
    (mapped,) = state()["mapped"]
    nowhere = state(mapped=[{**mapped, "pairs": [], "predicted_miss": 1.0}])
    (text,) = texts(running_checks.mapping({**nowhere, "ways": [ways()]}, lambda _: None), Level.FAIL)
    assert text == (
        "/plan: no mapping from the control plane, and no path to a server of it is up: requests go nowhere"
    )
    # A sidecar of an earlier version does not say over which paths requests go.
    assert texts(running_checks.mapping(nowhere, lambda _: None), Level.FAIL) == []
    dark = state(mapped=nowhere["mapped"], paths=[path("wlan0", "cloud-a", "down")])
    assert len(texts(running_checks.mapping(dark, lambda _: None), Level.FAIL)) == 1
    hopeless = state(mapped=[{**mapped, "predicted_miss": 0.97}])
    assert "predicted to miss 97 %" in texts(running_checks.mapping(hopeless, lambda _: None), Level.WARN)[0]
    assert texts(running_checks.mapping(state(), lambda _: None), *BAD) == []


@pytest.mark.audit("ops-14")
def test_a_server_that_stands_still_is_named() -> None:
    told = {"carried": {"/map": "nav_msgs/srv/GetMap"}, "unmet": [], "silent": ["/plan"]}
    cloud = {**state()["node"], "role": "cloud"}
    (text,) = texts(running_checks.services(state(services=told, node=cloud)), Level.FAIL)
    assert text == "/plan: the process of its server ended, or shows no sign of life"


def test_the_control_stream() -> None:
    lost = {"names": ["cp:50051"], "connected": False, "since_s": 90.0, "last_failure": "nothing arrives over wlan0"}
    (text,) = texts(running_checks.control(state(control=lost)), Level.WARN)
    assert text.startswith("cp:50051 not reached for 90 s: nothing arrives over wlan0; requests continue")
    nothing = state(control=lost, mapping={"version": 0}, paths=[])
    assert "nothing that it sent before is known" in texts(running_checks.control(nothing), Level.WARN)[0]
    dormant = state(control=lost, mapping={"version": 7}, paths=[], removed_peers=[DORMANT])
    assert "; the peers that it removed are kept, and" in texts(running_checks.control(dormant), Level.WARN)[0]
    mapped = state(control=lost, mapping={"version": 7}, paths=[])
    assert "; its last mapping is kept, but no peer is known" in texts(running_checks.control(mapped), Level.WARN)[0]


def test_a_socket_that_could_not_be_opened_fails() -> None:
    why = "its socket could not be opened: Address already in use (udp_port 24999)"
    assert texts(running_checks.devices(state(unopened={"lo": why})), Level.FAIL) == [f"lo: {why}"]
