"""What the program says of a configuration that it refuses."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from plr.sidecar.__main__ import main

if TYPE_CHECKING:
    from pathlib import Path


def test_names_the_file_that_is_wrong_not_the_configuration(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = tmp_path / "sidecar.yaml"
    config.write_text(f"tls_dir: {tmp_path / 'nowhere'}\ncontrol_plane: 192.0.2.1:50051\n")
    assert main(["--config", str(config), "--check-config"]) != 0
    assert capsys.readouterr().err.startswith(f"plr-sidecar: {tmp_path / 'nowhere'}: expected a folder with cert.pem")


def test_names_the_configuration_where_a_key_is_wrong(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = tmp_path / "sidecar.yaml"
    config.write_text("tls_dir: relative\ncontrol_plane: 192.0.2.1:50051\n")
    assert main(["--config", str(config), "--check-config"]) != 0
    assert capsys.readouterr().err.startswith(f"plr-sidecar: {config}: tls_dir: expected an absolute path")


@pytest.mark.audit("ops-2")
def test_an_empty_configuration_is_called_empty(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = tmp_path / "sidecar.yaml"
    config.write_text("# nothing yet\n")
    assert main(["--config", str(config), "--check-config"]) == 2
    assert capsys.readouterr().err == (
        f"plr-sidecar: {config}: expected keys and values, but it is empty; deploy/config has examples\n"
    )


@pytest.mark.audit("ops-4")
def test_a_deadline_in_seconds_is_doubted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "sidecar.yaml"
    config.write_text(
        "name: robot-1\nrole: robot\ninsecure: true\ncontrol_plane: 127.0.0.1:1\ninterfaces: [lo]\n"
        f"state_dir: {tmp_path}\nservices: [{{name: /plan, deadline_ms: 100}}, {{name: /look, deadline_ms: 0.2}}]\n"
    )
    monkeypatch.setattr("plr.sidecar.ros.environment.problem", lambda **_: None)
    assert main(["--config", str(config), "--check-config"]) == 0
    told = "0.2 ms is shorter than the round trip of any network; the unit is milliseconds"
    assert capsys.readouterr().err == f"plr-sidecar: warning: services[1].deadline_ms: {told}\n"
