"""`plr policy check`: its verdict, its words and its exit codes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from plr.controlplane.cli import __main__

if TYPE_CHECKING:
    from pathlib import Path

POLICY = """
insecure: true
policy:
  calls: [{robots: "arm-*", services: "/arm/*", clouds: [edge-1]}]
  offers: [{clouds: "edge-?", services: "*"}]
"""


def check(path: Path, robot: str = "arm-1", service: str = "/arm/grip", cloud: str = "edge-1") -> int:
    command = ["policy", "check", "--config", str(path), "--robot", robot, "--service", service, "--cloud", cloud]
    return __main__.main(command)


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "control.yaml"
    path.write_text(POLICY)
    return path


def test_allowed(config: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert check(config) == 0
    out = capsys.readouterr().out.splitlines()
    assert out[0] == "allowed"
    assert [line.split()[0] for line in out[1:]] == ["offers[0]", "calls[0]"]


def test_denied(config: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert check(config, robot="base-1") == 1
    out = capsys.readouterr().out
    assert out.startswith("denied\n")
    assert 'missing under calls: {robots: ["base-1"], services: ["/arm/grip"], clouds: ["edge-1"]}' in out


def test_without_a_policy_it_is_allowed_and_said_so(config: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config.write_text("insecure: true")
    assert check(config) == 0
    assert "no policy" in capsys.readouterr().out


def test_an_empty_policy_denies(config: Path) -> None:
    config.write_text("insecure: true\npolicy:\n")
    assert check(config) == 1


def test_a_bad_configuration_is_one_line(config: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config.write_text("insecure: true\npolicy: {calls: [{robots: [], services: /s, clouds: c}]}")
    assert check(config) == 2
    assert capsys.readouterr().err == f"plr: {config}: policy.calls[0].robots: expected at least 1 entry\n"


@pytest.mark.parametrize("wrong", [{"robot": "a b"}, {"service": "plan"}, {"cloud": ""}])
def test_a_name_that_nobody_can_have_is_bad_usage(config: Path, wrong: dict[str, str]) -> None:
    with pytest.raises(SystemExit) as exit_:
        check(config, **wrong)
    assert exit_.value.code == 2
