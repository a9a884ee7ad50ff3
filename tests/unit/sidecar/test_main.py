"""What the program says of a configuration that it refuses."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sidecar.__main__ import main

if TYPE_CHECKING:
    from pathlib import Path

    import pytest


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
