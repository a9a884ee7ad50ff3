"""The configuration parser returns a SidecarConfig or raises ConfigError, for whatever text."""

from __future__ import annotations

import contextlib

import yaml
from hypothesis import given
from hypothesis import strategies as st

from plr.protos.base.errors import ConfigError
from plr.sidecar.config.sidecar import SidecarConfig, parse_config

_KEYS = st.sampled_from([*SidecarConfig.model_fields, "deadline_ms", "name", "servers", "address", "enabled"])
_SCALARS = (
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20) | st.dates() | st.binary(max_size=4)
)
_VALUES = st.recursive(
    _SCALARS | st.sampled_from(["robot", "cloud", "a:1", "/a", "/*", "eth0"]),
    lambda children: st.lists(children, max_size=3) | st.dictionaries(_KEYS, children, max_size=4),
    max_leaves=12,
)


def check(text: str) -> None:
    try:
        config = parse_config(text, "f")
    except ConfigError as error:
        refusal = str(error)
    else:
        assert config.service_rules()
        return
    assert len(refusal.splitlines()) == 1


@given(st.text())
def test_any_text(text: str) -> None:
    check(text)


@given(st.text(alphabet="{}[]:,-&*!|>'\"%#?\n \tabf01._~<", max_size=60))
def test_text_of_yaml_indicators(text: str) -> None:
    check(text)


@given(st.dictionaries(_KEYS, _VALUES))
def test_any_values_under_known_keys(data: dict[str, object]) -> None:
    check(yaml.safe_dump(data))


@given(_KEYS, _VALUES)
def test_one_wrong_value_in_a_good_file(key: str, value: object) -> None:
    good = {
        "name": "c",
        "role": "cloud",
        "insecure": True,
        "control_plane": "a:1",
        "services": [{"name": "/*"}],
        key: value,
    }
    with contextlib.suppress(yaml.representer.RepresenterError):
        check(yaml.safe_dump(good))
