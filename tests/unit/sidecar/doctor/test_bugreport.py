"""What of a configuration is in a report."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest
import yaml

from sidecar.config import load_config
from sidecar.doctor import bugreport
from sidecar.doctor.examination import Examination, Where
from sidecar.doctor.finding import fail
from tests.unit.sidecar.configs import ROBOT

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.audit("ops-14")

WRONG = ROBOT | {"udp_port": "hunter2", "hunter2": 1, "api_tokens": ["hunter2"], "passwords": {"a": "hunter2"}}


@pytest.fixture(autouse=True)
def no_commands(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bugreport, "COMMANDS", {})


def test_of_one_that_is_wrong_the_known_keys(tmp_path: Path) -> None:
    path = tmp_path / "sidecar.yaml"
    path.write_text(yaml.safe_dump(WRONG))
    seen = Examination([fail("configuration", "udp_port: expected a whole number, got 'hunter2'", "correct it")])
    parts = dict(bugreport.parts(seen, Where(path)))
    assert "udp_port: (left out, as the configuration is wrong)\n" in parts["configuration.yaml"]
    assert parts["configuration.yaml"].endswith("# 3 keys that are not known\n")
    assert [name for name, text in parts.items() if "hunter2" in text] == []


def test_of_one_that_is_right_all_values(tmp_path: Path) -> None:
    path = tmp_path / "sidecar.yaml"
    path.write_text(yaml.safe_dump(ROBOT))
    seen = Examination(config=load_config(path), state={"node": {"name": "robot-1", "secret": "hunter2"}})
    parts = dict(bugreport.parts(seen, Where(path)))
    told = yaml.safe_load(parts["configuration.yaml"])
    assert (told["name"], told["services"][0]["name"]) == ("robot-1", "/plan_path")
    assert json.loads(parts["doctor.json"])["sidecar"]["node"] == {"name": "robot-1", "secret": "(left out)"}


def test_what_is_no_configuration_says_why(tmp_path: Path) -> None:
    path = tmp_path / "sidecar.yaml"
    path.write_text("- passphrase hunter2")
    parts = dict(bugreport.parts(Examination(), Where(path)))
    assert "expected keys and values, got (left out)" in parts["configuration.yaml"]
