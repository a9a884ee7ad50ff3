from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from pydantic import ValidationError

from protos.errors import ConfigError
from protos.identity import Identity, IdentityRole
from protos.model import InterfaceName, NodeName, Role, ServiceName
from protos.preferences import AT_MOST_EVERY_INTERFACE, EVERY_INTERFACE, Copies, InterfaceLabel
from sidecar.config import (
    DEFAULT_CLOUD_UDP_PORT,
    LogLevel,
    SidecarConfig,
    config_schema,
    load_config,
    parse_config,
    refuse_exposed,
)
from sidecar.core.budgets import Budget
from sidecar.core.fallback_rule import FallbackRule
from sidecar.core.priority import Priority
from sidecar.core.redundancy_mode import RedundancyMode

SOURCE = "sidecar.yaml"
ROBOT: dict[str, Any] = {
    "name": "robot-1",
    "role": "robot",
    "insecure": True,
    "control_plane": "plr.example.org:50051",
    "services": [{"name": "/plan_path", "deadline_ms": 100}],
}
CLOUD: dict[str, Any] = {
    "name": "cloud-a",
    "role": "cloud",
    "insecure": True,
    "control_plane": "[2001:db8::1]:50051",
    "services": [{"name": "/*"}],
}

SAFE: dict[str, Any] = {"idempotent": True}
BACKED: dict[str, Any] = {"deadline_ms": 100, "idempotent": True, "fallback": "/b"}


def parse(base: dict[str, Any], **changes: Any) -> SidecarConfig:
    return parse_config(yaml.safe_dump({**base, **changes}), SOURCE)


def with_service(base: dict[str, Any], **keys: Any) -> dict[str, Any]:
    return {**base, "services": [{**base["services"][0], **keys}]}


def test_smallest_robot_gets_the_defaults() -> None:
    config = parse(ROBOT)
    assert config.role is Role.ROBOT
    assert config.interfaces is None
    assert config.udp_port == 0
    assert config.stun.enabled
    assert config.stun.servers == ()
    assert config.state_dir == Path("/var/lib/plr")
    assert config.metrics_listen == "127.0.0.1:9464"
    assert config.log_level is LogLevel.INFO


def test_cloud_has_a_fixed_port_by_default_and_may_choose_another() -> None:
    assert parse(CLOUD).udp_port == DEFAULT_CLOUD_UDP_PORT
    assert parse(CLOUD, udp_port=0).udp_port == 0


def test_every_key_of_a_robot() -> None:
    config = parse(
        ROBOT,
        interfaces=["wlan0", "wwan*"],
        udp_port=40000,
        stun={"servers": ["stun.example.org:3478"]},
        state_dir="/tmp/plr",
        metrics_listen=None,
        log_level="debug",
    )
    assert config.interfaces == ("wlan0", "wwan*")
    assert config.stun.servers == ("stun.example.org:3478",)
    assert config.metrics_listen is None


def test_every_key_of_a_cloud() -> None:
    config = parse(
        CLOUD,
        advertise=[{"address": "203.0.113.7", "interface": "eth0"}, {"address": "2001:DB8::0:7"}],
        stun={"enabled": False},
        services=[{"name": "/plan_path", "capacity_interfaces": 4, "lifetime_ms": 1500}],
    )
    assert [entry.address for entry in config.advertise] == ["203.0.113.7", "2001:db8::7"]
    assert config.service_rules()[0].capacity == 4
    assert config.service_rules()[0].lifetime_s == 1.5


def test_config_is_frozen() -> None:
    config = parse(ROBOT)
    with pytest.raises(ValidationError):
        config.name = "other"


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


def test_copies_to_several_servers_only_when_asked_for() -> None:
    (rule,) = parse(ROBOT).service_rules()
    assert not rule.idempotent
    assert not rule.drop_late
    assert rule.priority is Priority.NORMAL


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
    changed = with_service(ROBOT, idempotent=True, redundancy="adaptive", target_miss=0.01)
    (rule,) = parse(changed).service_rules()
    assert (rule.redundancy, rule.adaptive_target) == (RedundancyMode.ADAPTIVE, 0.01)
    assert (rule.copies, rule.target_miss) == (EVERY_INTERFACE, 0.0), "it says nothing of the mapping"


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
    assert parse(with_service(CLOUD, cost_per_request=2)).service_rules()[0].charge == 2.0


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
    (with_service(ROBOT, copies="two"), "services[0].copies", "expected each, at_most or a number from 1 to 256"),
    (with_service(ROBOT, copies=0), "services[0].copies", "got 0"),
    (with_service(ROBOT, copies=True), "services[0].copies", "got True"),
    (with_service(CLOUD, copies=2), "services[0].copies", "on a robot only"),
    (with_service(ROBOT, mode="cheap"), "services[0].mode", "expected 'most_reliable' or 'cheapest'"),
    (with_service(ROBOT, mode="cheapest"), "services[0].target_miss", "beside mode: cheapest, but missing"),
    (with_service(ROBOT, target_miss=0.1), "services[0].target_miss", "only beside mode: cheapest or"),
    (with_service(ROBOT, mode="cheapest", target_miss=0), "services[0].target_miss", "greater than 0"),
    (with_service(ROBOT, mode="cheapest", target_miss=1.0), "services[0].target_miss", "less than 1"),
    (with_service(ROBOT, redundancy="all"), "services[0].redundancy", "'hedge', 'adaptive' or 'replicate'"),
    (with_service(ROBOT, redundancy="hedge"), "services[0].redundancy", "beside idempotent: true only"),
    (with_service(ROBOT, redundancy="adaptive"), "services[0].redundancy", "expected adaptive beside idempotent: true"),
    (with_service(CLOUD, redundancy="single"), "services[0].redundancy", "on a robot only"),
    (with_service(ROBOT, hedge_quantile=0.9), "services[0].hedge_quantile", "only beside redundancy: hedge"),
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
    (ROBOT | {"control_plane": "http://plr:50051"}, "control_plane", "in brackets"),
    (ROBOT | {"control_plane": "-plr:50051"}, "control_plane", "host name"),
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


def test_a_parameter_service_may_stand_behind_a_glob_which_does_not_open_it() -> None:
    parse(ROBOT, services=services("/a/*", "/a/get_parameters"))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "name: expected, but missing (and 3 more)"),
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


def test_merge_keys_of_yaml_work() -> None:
    text = """
name: robot-1
role: robot
insecure: true
control_plane: c:1
services:
- &first {name: /a, deadline_ms: 100}
- {<<: *first, name: /b}
"""
    assert [rule.deadline_s for rule in parse_config(text, SOURCE).service_rules()] == [0.1, 0.1]


def test_a_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "sidecar.yaml"
    path.write_text(yaml.safe_dump(ROBOT))
    assert load_config(path).name == "robot-1"


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    for path in (tmp_path / "absent.yaml", tmp_path):
        with pytest.raises(ConfigError, match=rf"^{path}: cannot be read: "):
            load_config(path)


def test_a_file_that_is_not_text_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "sidecar.yaml"
    path.write_bytes(b"name: \xff\n")
    with pytest.raises(ConfigError, match="expected UTF-8"):
        load_config(path)


def test_an_oversized_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "sidecar.yaml"
    path.write_bytes(b"#" * ((1 << 20) + 1))
    with pytest.raises(ConfigError, match="at most 1048576 bytes"):
        load_config(path)


def test_schema_describes_every_key_and_is_json() -> None:
    schema = json.loads(json.dumps(config_schema()))
    assert schema["additionalProperties"] is False
    assert set(schema["properties"]) == set(SidecarConfig.model_fields)
    assert all("description" in entry or "$ref" in entry for entry in schema["properties"].values())
    service = schema["$defs"]["ServiceConfig"]
    assert all("description" in entry for entry in service["properties"].values())


def certificate(name: str = "robot-1", role: IdentityRole = IdentityRole.ROBOT) -> Identity:
    return Identity(NodeName(name), role, 1, 0.0, 1.0)


def parse_certified(identity: Identity, **keys: Any) -> SidecarConfig:
    base = {"control_plane": "plr.example.org:50051", "tls_dir": "/etc/plr/tls", "services": ROBOT["services"]}
    return parse_config(yaml.safe_dump({**base, **keys}), SOURCE, lambda _: identity)


def test_name_and_role_come_from_the_certificate() -> None:
    config = parse_certified(certificate())
    assert (config.name, config.role) == ("robot-1", Role.ROBOT)
    assert parse_certified(certificate(), name="robot-1", role="robot") == config
    assert config_schema()["required"] == ["control_plane", "services"]


@pytest.mark.parametrize(
    ("identity", "keys", "told"),
    [
        (
            certificate(),
            {"name": "robot-2"},
            "name: expected 'robot-1' as in the certificate, or nothing, got 'robot-2'",
        ),
        (certificate(), {"role": "cloud"}, "role: expected 'robot' as in the certificate"),
        (certificate("al", IdentityRole.OPERATOR), {}, "tls_dir: expected the certificate of a robot or a cloud"),
        (certificate(), {"insecure": True}, "insecure: expected without tls_dir"),
        (certificate(), {"tls_dir": "tls"}, "tls_dir: expected an absolute path, got 'tls'"),
    ],
)
def test_what_does_not_fit_the_certificate_is_refused(identity: Identity, keys: dict[str, Any], told: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_certified(identity, **keys)
    assert told in str(caught.value)


def test_insecure_mode_is_for_the_same_machine() -> None:
    refuse_exposed(parse_certified(certificate()), SOURCE)
    for target in ("127.0.0.1:1", "[::1]:1", "localhost:1"):
        refuse_exposed(parse(ROBOT, control_plane=target), SOURCE)
    for target in ("192.0.2.1:1", "[2001:db8::1]:1", "control.example.org:1"):
        with pytest.raises(ConfigError, match="control_plane: expected a loopback address with insecure: true"):
            refuse_exposed(parse(ROBOT, control_plane=target), SOURCE)
