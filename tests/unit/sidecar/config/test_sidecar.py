from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from pydantic import ValidationError

from plr.protos.base.errors import ConfigError
from plr.protos.model.ids import InterfaceName, NodeName, Role
from plr.protos.trust.identity import Identity, IdentityRole
from plr.sidecar.config.sidecar import (
    DEFAULT_CLOUD_UDP_PORT,
    LogLevel,
    SidecarConfig,
    config_schema,
    load_config,
    parse_config,
    refuse_exposed,
)
from plr.sidecar.core.control.ways import Price
from tests.unit.sidecar.configs import CLOUD, ROBOT, SOURCE, parse


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
    deadline = service["properties"]["deadline_ms"]
    assert deadline["x-role"] == "robot"
    assert deadline["description"].startswith("Robot only. ")
    assert "x-role" not in service["properties"]["lifetime_ms"]


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
        (
            certificate("c", IdentityRole.CLOUD),
            {},
            "expected on a robot only: it is the robot's sidecar that decides this; by its certificate this node is a "
            "cloud",
        ),
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

    both = ["127.0.0.1:1", "192.0.2.1:1"]
    with pytest.raises(ConfigError, match=r"with insecure: true, got '192\.0\.2\.1:1'"):
        refuse_exposed(parse(ROBOT, control_plane=both), SOURCE)


def test_the_control_plane_has_one_address_or_several() -> None:
    assert parse(ROBOT, control_plane="a:1").control_plane == ("a:1",)
    assert parse(ROBOT, control_plane=["a:1", "[2001:db8::1]:2"]).control_plane == ("a:1", "[2001:db8::1]:2")


def test_what_the_control_stream_costs_comes_from_the_networks() -> None:
    networks = [
        {"interface": "wwan0", "extra_mb_per_day": 100, "cost_per_request": 0.1},
        {"interface": "wwan*", "cost_per_request": 2.0},
    ]
    config = parse(ROBOT, networks=networks)
    prices = [config.price(InterfaceName(name)) for name in ("wlan0", "wwan1", "wwan0")]
    assert prices == [
        Price(cost_per_request=1.0),
        Price(cost_per_request=2.0),
        Price(billed=True, cost_per_request=0.1),
    ]
    assert prices == sorted(prices)
