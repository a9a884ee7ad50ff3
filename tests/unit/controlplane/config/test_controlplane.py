"""The configuration: defaults, every kind of mistake as one line, and no byte string that breaks the parser."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from plr.controlplane.config.controlplane import ControlPlaneConfig, load_config, parse_config
from plr.controlplane.core.policy.path_rules import PathRule
from plr.controlplane.core.policy.policy import CallRule, OfferRule, Policy
from plr.protos.base.errors import ConfigError
from plr.protos.base.host_port import check_remote, split_host_port
from plr.protos.program.config_file import MAX_CONFIG_BYTES

if TYPE_CHECKING:
    from pathlib import Path


def read(text: str) -> ControlPlaneConfig:
    return parse_config(f"insecure: true\n{text}", "control.yaml")


def test_an_empty_file_means_the_defaults() -> None:
    config = read("")
    assert config == ControlPlaneConfig(insecure=True)
    assert config.default_capacity_interfaces == 1
    assert config.settings().lease_s == 5.0
    assert config.settings().half_life_s == 60.0


def test_one_address_may_stand_without_a_list() -> None:
    assert read("stun_listen: '127.0.0.1:3478'").stun_listen == ("127.0.0.1:3478",)
    assert read("stun_listen: []").stun_listen == ()
    assert read("stun_servers: [a.example:1, '[2001:db8::1]:2']").settings().stun_servers == (
        "a.example:1",
        "[2001:db8::1]:2",
    )


def test_the_schema_knows_an_address_without_a_list() -> None:
    one, several = ControlPlaneConfig.model_json_schema()["properties"]["stun_listen"]["anyOf"]
    assert one == several["items"] == {"type": "string", "format": "address:port"}
    assert several["maxItems"] == 16


def test_path_rules_match_everything_that_they_do_not_name() -> None:
    text = "paths: [{robots: 'arm-*', interfaces: [wwan*, sat0], allow: true}, {clouds: far, allow: false}]"
    assert read(text).settings().path_rules == (
        PathRule(("arm-*",), ("wwan*", "sat0"), ("*",), allow=True),
        PathRule(("*",), ("*",), ("far",), allow=False),
    )


def test_no_policy_is_another_thing_than_an_empty_one() -> None:
    assert read("").settings().policy is None
    assert read("policy:").settings().policy == Policy()
    assert read("policy: {}").settings().policy == Policy()


def test_a_policy_is_read_with_lists_or_single_patterns() -> None:
    text = "policy: {calls: [{robots: 'r-*', services: [/a, /b/*], clouds: '*'}], offers: [{clouds: c, services: /a}]}"
    assert read(text).settings().policy == Policy(
        (CallRule(("r-*",), ("/a", "/b/*"), ("*",)),), (OfferRule(("c",), ("/a",)),)
    )


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("lease: 3", "lease: unknown key; did you mean lease_ms?"),
        ("paths: [{robots: a}]", "paths[0].allow: expected, but missing"),
        (
            "paths: [{interfaces: 'wlan 0', allow: true}]",
            "paths[0].interfaces[0]: matches no name",
        ),
        ("policy: []", "policy: expected keys and values, got []"),
        ("policy: {call: []}", "policy.call: unknown key; did you mean calls?"),
        ("policy: {calls: null}", "policy.calls: expected a list, got nothing"),
        ("policy: {calls: [{robots: r, services: /s}]}", "policy.calls[0].clouds: expected, but missing"),
        ("policy: {offers: [{robots: r, services: /s, clouds: c}]}", "policy.offers[0].robots: unknown key; expected"),
        ("policy: {offers: [{clouds: [], services: /s}]}", "policy.offers[0].clouds: expected at least 1 entry"),
        ("policy: {offers: [{clouds: [c, c], services: /s}]}", "policy.offers[0].clouds: expected each entry once"),
        (
            "policy: {offers: [{clouds: 'c d', services: /s}]}",
            "policy.offers[0].clouds[0]: matches no name",
        ),
        (
            "policy: {offers: [{clouds: c, services: plan}]}",
            "policy.offers[0].services[0]: matches no name",
        ),
        ("xyz: 3", "xyz: unknown key; expected one of default_capacity_interfaces, "),
        ("lease_ms: soon", "lease_ms: expected a whole number, got 'soon'"),
        ("lease_ms: [1]", "lease_ms: expected a whole number, got [1]"),
        ("lease_ms: 1", "lease_ms: expected greater than or equal to 500, got 1"),
        ("lease_ms: 600\ninsecure: true", "lease_ms: expected at least three times report_interval_ms (500), got 600"),
        ("insecure: 't'", "insecure: expected true or false, got 't'"),
        ("insecure: 1", "insecure: expected true or false, got 1"),
        ("lease_ms: ' 5_000 '", "lease_ms: expected a whole number, got ' 5_000 '"),
        ("lease_ms: 5000.0", "lease_ms: expected a whole number, got 5000.0"),
        ("histogram_half_life_s: true", "histogram_half_life_s: expected a number, got True"),
        ("histogram_half_life_s: .nan", "histogram_half_life_s: expected a finite number, got nan"),
        ("paths: [{robots: a, allow: y}]", "paths[0].allow: expected true or false, got 'y'"),
        ("listen: '50051'", "listen: expected host:port with a port up to 65535, got '50051'"),
        ("listen: ':50051'", "listen: expected host:port with a port up to 65535, got ':50051'"),
        ("listen: '::1:50051'", "listen: expected an IPv6 address in brackets, as in"),
        ("listen: '[::g]:1'", "listen: expected an IP address, got '::g'"),
        ("listen: 'a:70000'", "listen: expected host:port with a port up to 65535, got 'a:70000'"),
        ("stun_listen: ['0.0.0.0:1', '0.0.0.0:1']", "stun_listen: expected each entry once, got '0.0.0.0:1' twice"),
        (
            "stun_listen: [0.0.0.0:1, 2]",
            "stun_listen[1]: expected address:port, such as [::]:2 for all addresses, got 2",
        ),
        ("stun_servers: '0.0.0.0:3478'", "stun_servers[0]: expected an address that can be reached, got"),
        ("stun_servers: 'a:0'", "stun_servers[0]: expected host:port with a port from 1 to 65535, got 'a:0'"),
        ("log_level: loud", "log_level: expected 'debug', 'info', 'warning' or 'error', got 'loud'"),
        ("listen: [::]:50051", "line 1: expected YAML: expected the node content, but found ':'; put a value that"),
        ("paths:\n  - robots: *", "line 2: expected YAML: expected alphabetic or numeric character, but found"),
        ("paths:\n  - {allow: true, 1: 2}", "paths[0][1]: expected a key that is text, got 1; quote it"),
        ("{a: 1}: 1", "line 1: expected YAML: a key has to be text"),
        ("lease_ms: 5000\nlease_ms: 6000", "line 2: expected YAML: key 'lease_ms' is written twice"),
        ("1: 2", "1: expected a key that is text; quote it"),
        ("- lease_ms", "expected keys and values, got ['lease_ms']"),
        ("a: [", "line 1: expected YAML: "),
        ("a: !!int x", "expected YAML: "),
        ("a: !!python/object:os.system x", "line 1: expected YAML: could not determine a constructor"),
    ],
)
def test_a_mistake_is_one_line_that_names_file_key_and_expectation(text: str, line: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_config(text, "control.yaml")
    assert str(caught.value).startswith(f"control.yaml: {line}")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "text",
    ["listen: [::]:1", "stun_listen:\n  - [::1]:1", "paths:\n  - robots: *\n", "paths: [{robots: *, allow: no}]"],
)
def test_what_needs_quotes_is_said(text: str) -> None:
    with pytest.raises(ConfigError, match=r"put a value that begins with \[ or \* in quotes"):
        parse_config(text, "control.yaml")


def test_a_long_value_is_cut() -> None:
    with pytest.raises(ConfigError) as caught:
        read(f"paths: [{{robots: '{'x' * 100_000}', allow: true}}, {{robots: '{'?' * 200}', allow: true}}]")
    assert len(str(caught.value)) < 600
    with pytest.raises(ConfigError, match=r"1000 or 1\.0e\+3"):
        read("lease_ms: 5e3")


def test_several_mistakes_are_counted() -> None:
    with pytest.raises(ConfigError, match=r"\(and 1 more\)$"):
        read("lease_ms: x\nlog_level: y")


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read: No such file"):
        load_config(tmp_path / "none.yaml")
    with pytest.raises(ConfigError, match="cannot be read: Is a directory"):
        load_config(tmp_path)
    large = tmp_path / "large.yaml"
    large.write_bytes(b"#" * (MAX_CONFIG_BYTES + 1))
    with pytest.raises(ConfigError, match="at most"):
        load_config(large)


def test_it_is_frozen() -> None:
    config = read("")
    with pytest.raises(ValidationError, match="frozen"):
        config.lease_ms = 1


@given(st.text(max_size=60) | st.text(alphabet="abl_ms:[]{}&*!|>-'\"\n 01.#%@", max_size=40))
def test_any_text_is_read_or_refused(text: str) -> None:
    with contextlib.suppress(ConfigError):
        assert isinstance(read(text), ControlPlaneConfig)


@given(st.text(max_size=30))
def test_any_text_is_an_address_or_refused(text: str) -> None:
    for check in (split_host_port, check_remote):
        with contextlib.suppress(ValueError):
            assert check(text)


def test_addresses_are_split() -> None:
    assert split_host_port("[::]:50051") == ("::", 50051)
    assert split_host_port("control.example.org:1") == ("control.example.org", 1)
    assert split_host_port("10.0.0.1:0") == ("10.0.0.1", 0)
