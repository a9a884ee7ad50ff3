from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
import yaml

from plr.protos.base.errors import ConfigError
from plr.sidecar.config import sidecar as sidecar_config
from plr.sidecar.config.sidecar import MAX_SERVICES, parse_config
from plr.sidecar.core.rules.service_rule import Rules, ServiceRule
from tests.unit.sidecar.configs import BACKED, CLOUD, ROBOT, SAFE, SOURCE, parse, with_service

if TYPE_CHECKING:
    from collections.abc import Iterable

BAD_VALUES: list[tuple[dict[str, Any], str, str]] = [
    (ROBOT | {"interface": ["wlan0"]}, "interface", "unknown key; did you mean interfaces?"),
    (ROBOT | {"zzz": 1}, "zzz", "unknown key; expected one of advertise, control_plane"),
    (with_service(ROBOT, deadline_s=0.1), "services[0].deadline_s", "did you mean deadline_ms?"),
    (ROBOT | {"stun": {"enable": True}}, "stun.enable", "did you mean enabled?"),
    (with_service(ROBOT, deadline_ms="100ms"), "services[0].deadline_ms", "expected a number, got '100ms'"),
    (with_service(ROBOT, deadline_ms="100"), "services[0].deadline_ms", "expected a number, got '100'"),
    (with_service(ROBOT, deadline_ms=True), "services[0].deadline_ms", "expected a number"),
    (with_service(ROBOT, deadline_ms=0), "services[0].deadline_ms", "greater than 0"),
    (with_service(ROBOT, deadline_ms=float("nan")), "services[0].deadline_ms", "finite"),
    (with_service(ROBOT, deadline_ms=60_001), "services[0].deadline_ms", "60000"),
    (with_service(ROBOT, lifetime_ms=100), "services[0].lifetime_ms", "more than deadline_ms (100), got 100"),
    (with_service(ROBOT, lifetime_ms=300_001), "services[0].lifetime_ms", "300000"),
    (with_service(CLOUD, lifetime_ms=300_001), "services[0].lifetime_ms", "300000"),
    (with_service(ROBOT, capacity_interfaces=1), "services[0].capacity_interfaces", "on a cloud only"),
    (
        with_service(ROBOT, type="GetPlan"),
        "services[0].type",
        "expected a type of services such as",
    ),
    (with_service(CLOUD, type="t/srv/T"), "services[0].type", "on a robot only"),
    (ROBOT | {"metrics_listen": 9464}, "metrics_listen", "expected address:port, such as [::]:9464 for all addresses"),
    (with_service(ROBOT, copies="two"), "services[0].copies", "expected each, at_most or a number from 1 to 256"),
    (with_service(ROBOT, copies=0), "services[0].copies", "got 0"),
    (with_service(ROBOT, copies=True), "services[0].copies", "got True"),
    (with_service(CLOUD, copies=2), "services[0].copies", "on a robot only"),
    (with_service(ROBOT, mode="cheap"), "services[0].mode", "expected 'most_reliable' or 'cheapest'"),
    (with_service(ROBOT, mode="cheapest"), "services[0].target_miss", "beside mode: cheapest, but missing"),
    (with_service(ROBOT, target_miss=0.1), "services[0].target_miss", "only beside mode: cheapest or"),
    (with_service(ROBOT, mode="cheapest", target_miss=0), "services[0].target_miss", "greater than 0"),
    (with_service(ROBOT, mode="cheapest", target_miss=1.0), "services[0].target_miss", "less than 1"),
    (with_service(ROBOT, redundancy="all"), "services[0].redundancy", "'adaptive', 'share' or 'replicate'"),
    (with_service(ROBOT, redundancy="hedge"), "services[0].redundancy", "beside idempotent: true only"),
    (with_service(ROBOT, redundancy="adaptive"), "services[0].redundancy", "expected adaptive beside idempotent: true"),
    (with_service(CLOUD, redundancy="single"), "services[0].redundancy", "on a robot only"),
    (with_service(ROBOT, hedge_quantile=0.9), "services[0].hedge_quantile", "only beside redundancy: hedge"),
    (with_service(ROBOT, repeats=0.5), "services[0].repeats", "only beside redundancy: share"),
    (with_service(ROBOT, redundancy="share", repeats=1.5), "services[0].repeats", "1"),
    (with_service(ROBOT, hedge_quantile=1), "services[0].hedge_quantile", "0.99"),
    (with_service(CLOUD, fallback="/b"), "services[0].fallback", "on a robot only"),
    (with_service(ROBOT, fallback="/b"), "services[0].fallback", "beside idempotent: true only"),
    (with_service(ROBOT, **SAFE, fallback="/b*"), "services[0].fallback", "a service name such as /plan_locally"),
    (with_service(ROBOT, **SAFE, fallback="/plan_path"), "services[0].fallback", "expected another service"),
    (with_service(ROBOT, **SAFE, name="/*", fallback="/b"), "services[0].fallback", "the full name of one service"),
    (with_service(ROBOT, fallback_takes_ms=5), "services[0].fallback_takes_ms", "only beside fallback"),
    (with_service(ROBOT, fallback_start="on_miss"), "services[0].fallback_start", "only beside fallback"),
    (
        with_service(ROBOT, **SAFE, deadline_ms=100, fallback="/b", fallback_takes_ms=95),
        "services[0].fallback_takes_ms",
        "expected less than 95",
    ),
    (
        with_service(ROBOT, **SAFE, fallback="/b", fallback_takes_ms=5, fallback_start="on_miss"),
        "services[0].fallback_takes_ms",
        "only beside fallback_start: in_time",
    ),
    (
        ROBOT | {"services": [{**BACKED, "name": "/a"}, {**BACKED, "name": "/c"}]},
        "services[1].fallback",
        "expected another than that of services[0]",
    ),
    (
        ROBOT | {"services": [{**BACKED, "name": "/a"}, {"name": "/b", "deadline_ms": 100}]},
        "services[1].name",
        "expected a service that is not the fallback of services[0]",
    ),
    (ROBOT | {"networks": [{"interface": "wlan0", "extra_load": -1}]}, "networks[0].extra_load", "equal to 0"),
    (ROBOT | {"networks": [{"interface": "wlan0", "extra_mb_per_day": -1}]}, "networks[0].extra_mb_per_day", "to 0"),
    (with_service(ROBOT, cost_per_request=1), "services[0].cost_per_request", "on a cloud only"),
    (with_service(CLOUD, cost_per_request=-1), "services[0].cost_per_request", "greater than or equal to 0"),
    (ROBOT | {"region": "eu"}, "region", "on a cloud only"),
    (CLOUD | {"region": "eu central"}, "region", "expected 1 to 63 letters"),
    (CLOUD | {"networks": [{"interface": "eth0"}]}, "networks", "on a robot only"),
    (with_service(ROBOT, name="/arm/[z-a]"), "services[0].name", "expected brackets such as [ab] or [a-z]"),
    (with_service(ROBOT, name="/arm/["), "services[0].name", "expected brackets such as [ab] or [a-z]"),
    (ROBOT | {"control_plane": "1:50051"}, "control_plane", "expected an IP address, got '1'"),
    (ROBOT | {"control_plane": "010.000.000.001:50051"}, "control_plane", "expected an IP address"),
    (ROBOT | {"control_plane": "224.0.0.1:50051"}, "control_plane", "not of a multicast group"),
    (ROBOT | {"networks": [{"interface": "wlan0"}] * 2}, "networks[1].interface", "once, got 'wlan0' again"),
    (ROBOT | {"networks": [{"interface": "wlan0", "carrier": "a b"}]}, "networks[0].carrier", "expected 1 to 63"),
    (ROBOT | {"services": [{"name": "/a"}]}, "services[0].deadline_ms", "expected milliseconds"),
    (with_service(CLOUD, deadline_ms=100), "services[0].deadline_ms", "on a robot only"),
    (with_service(CLOUD, idempotent=False), "services[0].idempotent", "on a robot only"),
    (with_service(CLOUD, drop_late=True), "services[0].drop_late", "on a robot only"),
    (with_service(CLOUD, exploration=0.01), "services[0].exploration", "on a robot only"),
    (with_service(ROBOT, exploration=0.01), "services[0].exploration", "expected beside idempotent: true"),
    (with_service(ROBOT, exploration=0.2), "services[0].exploration", "0.1"),
    (with_service(CLOUD, priority="high"), "services[0].priority", "on a robot only"),
    (with_service(ROBOT, fec=True), "services[0].fec", "expected off, auto or a number from 0 to 1, got True"),
    (with_service(ROBOT, fec="lots"), "services[0].fec", "expected off, auto or a number from 0 to 1, got 'lots'"),
    (with_service(CLOUD, fec=1.01), "services[0].fec", "expected off, auto or a number from 0 to 1, got 1.01"),
    (with_service(ROBOT, priority="urgent"), "services[0].priority", "expected 'low', 'normal' or 'high'"),
    (with_service(ROBOT, priority=1), "services[0].priority", "expected 'low', 'normal' or 'high'"),
    (
        with_service(CLOUD, capacity_interfaces=0),
        "services[0].capacity_interfaces",
        "greater than or equal to 1",
    ),
    (ROBOT | {"services": []}, "services", "at least 1 entry"),
    (ROBOT | {"services": {"/a": 1}}, "services", "expected a list"),
    (with_service(ROBOT, name="plan_path"), "services[0].name", "expected a service name such as /plan_path"),
    (with_service(ROBOT, name="/plan path"), "services[0].name", "expected a service name"),
    (with_service(ROBOT, name="/a/"), "services[0].name", "expected a service name"),
    (with_service(ROBOT, name="/" + "a" * 255), "services[0].name", "expected a service name"),
    (ROBOT | {"role": "server"}, "role", "expected 'robot' or 'cloud', got 'server'"),
    (ROBOT | {"name": 1.10}, "name", "expected text, got 1.1"),
    (ROBOT | {"name": ""}, "name", "expected 1 to 63 letters"),
    (ROBOT | {"name": "robot\n1"}, "name", "expected 1 to 63 letters"),
    (ROBOT | {"control_plane": "plr.example.org"}, "control_plane", "expected host:port"),
    (ROBOT | {"control_plane": "plr.example.org:0"}, "control_plane", "a port from 1 to 65535"),
    (ROBOT | {"control_plane": "plr.example.org:65536"}, "control_plane", "up to 65535"),
    (ROBOT | {"control_plane": "::1:50051"}, "control_plane", "in brackets"),
    (ROBOT | {"control_plane": "http://plr:50051"}, "control_plane", "without http://"),
    (ROBOT | {"control_plane": "https://plr.example.org"}, "control_plane", "expected host:port without https://"),
    (ROBOT | {"control_plane": "-plr:50051"}, "control_plane", "host name"),
    (ROBOT | {"control_plane": []}, "control_plane", "a list of 1 to 8"),
    (ROBOT | {"control_plane": [f"c{n}:1" for n in range(9)]}, "control_plane", "a list of 1 to 8"),
    (ROBOT | {"control_plane": ["c:1", 2]}, "control_plane", "a list of 1 to 8"),
    (ROBOT | {"control_plane": ["c:1", "c"]}, "control_plane", "expected host:port"),
    (ROBOT | {"control_plane": ["c:1", "c:1"]}, "control_plane", "'c:1' twice"),
    (ROBOT | {"interfaces": []}, "interfaces", "at least 1 entry"),
    (ROBOT | {"interfaces": "wlan0"}, "interfaces", "expected a list, got 'wlan0'"),
    (ROBOT | {"interfaces": ["wlan0", "wlan0"]}, "interfaces", "'wlan0' twice"),
    (ROBOT | {"interfaces": ["sixteencharacter"]}, "interfaces[0]", "at most 15 characters"),
    (ROBOT | {"udp_port": 65536}, "udp_port", "65535"),
    (ROBOT | {"udp_port": 1.0}, "udp_port", "a whole number"),
    (ROBOT | {"advertise": [{"address": "203.0.113.7"}]}, "advertise", "on a cloud only"),
    (CLOUD | {"advertise": [{"address": "203.0.113.7:1"}]}, "advertise[0].address", "expected an IP address"),
    (CLOUD | {"advertise": [{"address": "fe80::1%eth0"}]}, "advertise[0].address", "without a zone"),
    (CLOUD | {"advertise": [{"address": "203.0.113.7"}] * 2}, "advertise[1]", "once"),
    (CLOUD | {"advertise": [{"address": "203.0.113.7"}], "udp_port": 0}, "udp_port", "expected a fixed port"),
    (
        CLOUD | {"advertise": [{"address": "203.0.113.7", "interface": "eth*"}]},
        "advertise[0].interface",
        "expected a name",
    ),
    (ROBOT | {"stun": {"enabled": False, "servers": ["s:1"]}}, "stun", "no servers while enabled is false"),
    (ROBOT | {"stun": {"servers": ["s"]}}, "stun.servers[0]", "expected host:port"),
    (ROBOT | {"stun": None}, "stun", "expected keys and values, got nothing"),
    (ROBOT | {"state_dir": "plr"}, "state_dir", "absolute path, got 'plr'"),
    (ROBOT | {"state_dir": "/a\0b"}, "state_dir", r"expected a path, got one with a NUL: '/a\x00b'"),
    (
        ROBOT | {"state_dir": "/\ud83d\ude00"},
        "state_dir",
        "expected a path, got one with characters that names cannot have",
    ),
    (
        ROBOT | {"tls_dir": "/\ud83d\ude00"},
        "tls_dir",
        "expected a path, got one with characters that names cannot have",
    ),
    (
        ROBOT | {"local_socket": "/\ud83d"},
        "local_socket",
        "expected a path, got one with characters that names cannot have",
    ),
    (ROBOT | {"tls_dir": "/a\0b"}, "tls_dir", r"expected a path, got one with a NUL: '/a\x00b'"),
    (ROBOT | {"local_socket": "/a\0b"}, "local_socket", "expected a path, got one with a NUL"),
    (ROBOT | {"metrics_listen": "localhost:9464"}, "metrics_listen", "expected an IP address"),
    (ROBOT | {"log_level": "loud"}, "log_level", "expected 'debug', 'info'"),
]


@pytest.mark.parametrize(("data", "key", "expected"), BAD_VALUES)
def test_a_bad_value_is_refused_in_one_line(data: dict[str, Any], key: str, expected: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_config(yaml.safe_dump(data), SOURCE)
    text = str(caught.value)
    assert caught.value.key == key
    assert text.startswith(f"{SOURCE}: {key}: ")
    assert expected in text
    assert "\n" not in text
    assert "more)" not in text


@pytest.mark.parametrize("key", ["name", "role", "control_plane", "services"])
def test_a_missing_key_is_named(key: str) -> None:
    data = {name: value for name, value in ROBOT.items() if name != key}
    with pytest.raises(ConfigError, match=rf"^{SOURCE}: {key}: expected, but missing$"):
        parse_config(yaml.safe_dump(data), SOURCE)


def test_further_problems_are_counted() -> None:
    with pytest.raises(ConfigError, match=r"\(and 2 more\)$"):
        parse(ROBOT, name="", udp_port=-1, log_level="loud")


def services(*names: str) -> list[dict[str, Any]]:
    return [{"name": name, "deadline_ms": 100} for name in names]


def test_a_pattern_written_twice_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"services\[2\]\.name: .*'/arm/\*' in services\[0\] too"):
        parse(ROBOT, services=services("/arm/*", "/b", "/arm/*"))


def test_a_name_behind_a_glob_that_matches_it_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"services\[1\]\.name: expected before the glob '/a\*'"):
        parse(ROBOT, services=services("/a*", "/ab"))
    parse(ROBOT, services=services("/ab", "/a*"))


@pytest.mark.audit("ops-5")
def test_a_glob_behind_one_that_matches_all_of_it_is_refused() -> None:
    with pytest.raises(
        ConfigError, match=r"services\[1\]\.name: expected before the glob '/\*', which matches '/arm/\*'"
    ):
        parse(ROBOT, services=services("/*", "/arm/*"))
    parse(ROBOT, services=services("/arm/*", "/*"))
    parse(ROBOT, services=services("/arm/?", "/arm/*", "/leg/*"))


@pytest.mark.audit("ops-5")
def test_a_network_behind_a_glob_that_matches_it_is_refused() -> None:
    for later in ("wlan0", "wl*"):
        with pytest.raises(ConfigError, match=r"networks\[1\]\.interface: expected before '\*', which matches 'wl"):
            parse(ROBOT, networks=[{"interface": "*"}, {"interface": later, "cost_per_request": 2}])
    parse(ROBOT, networks=[{"interface": "wlan0"}, {"interface": "wl*"}, {"interface": "*"}])


@pytest.mark.audit("ops-5")
def test_many_services_are_checked_against_one_set_of_rules(monkeypatch: pytest.MonkeyPatch) -> None:
    made = 0

    class Counted(Rules):
        def __init__(self, rules: Iterable[ServiceRule]) -> None:
            nonlocal made
            made += 1
            super().__init__(rules)

    monkeypatch.setattr(sidecar_config, "Rules", Counted)
    parse(ROBOT, services=services(*(f"/service_{number}" for number in range(MAX_SERVICES))))
    assert made == 1
    with pytest.raises(ConfigError, match=rf"services: .*{MAX_SERVICES}"):
        parse(ROBOT, services=services(*(f"/service_{number}" for number in range(MAX_SERVICES + 1))))


def test_a_parameter_service_may_stand_behind_a_glob_which_does_not_open_it() -> None:
    parse(ROBOT, services=services("/a/*", "/a/get_parameters"))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "expected keys and values, but it is empty; deploy/config has examples"),
        ("- name", "expected keys and values"),
        ("name: [", "line 1: expected YAML"),
        ("name: a\nrole: robot\nname: b\n", "line 3: expected YAML: key 'name' is written twice"),
        ("services:\n- {name: /a, name: /b}\n", "key 'name' is written twice"),
        ("1: a", "expected a key that is text"),
        ("name: !!python/object/apply:os.system [true]", "line 1: expected YAML"),
        ("name: !!int x", "expected YAML"),
        ("name: !!bool x", "expected YAML"),
        ("name: !!timestamp x", "expected YAML"),
        ("name: 2026-02-31", "expected YAML"),
        ("{[a]: b}", "expected YAML"),
        ("a: *b", "expected YAML"),
        ("[" * 5000, "expected YAML"),
        ("name: \x00", "expected YAML"),
    ],
)
def test_text_that_is_not_our_yaml_is_refused(text: str, expected: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_config(text, SOURCE)
    assert expected in str(caught.value)
    assert str(caught.value).startswith(f"{SOURCE}: ")
    assert "\n" not in str(caught.value)
