"""A revocation reaches the sidecars also when the control plane has never heard of whom it hits."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from lab import Lab, LabConfig
from lab.system import System
from plr.protos.trust.identity import IdentityRole

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = [pytest.mark.netns, pytest.mark.ros, pytest.mark.timeout(180)]


def test_a_server_revoked_while_the_control_plane_is_away(tmp_path: Path) -> None:
    with Lab(LabConfig.of(interfaces=("wlan0",), clouds=2), seed=1) as lab:
        system = System(lab, tmp_path)
        try:
            system.start_control_plane()
            for cloud in ("cloud_a", "cloud_b"):
                system.start_cloud(cloud, [{"name": "/echo"}])
            robot = system.start_robot([{"name": "/echo", "deadline_ms": 100}], interfaces=("wlan0",))

            def paths(peer: str) -> list[float]:
                metrics = system.metrics("robot")
                return [up for name, up in metrics.items() if name.startswith("plr_path_up") and peer in name]

            system.wait("both paths", lambda: paths("cloud-a") == paths("cloud-b") == [1.0])
            system.parts["controlplane"].kill()
            system.authority.revoke("cloud-a")
            control = system.tls_dir("control", IdentityRole.CONTROL_PLANE)
            (tmp_path / "crl.part").write_bytes(system.authority.crl_pem())
            (tmp_path / "crl.part").replace(f"{control}/crl.pem")
            assert paths("cloud-a") == [1.0], "nobody has told the robot"
            system.start_control_plane()
            system.wait("the robot to part with it", lambda: not any(paths("cloud-a")))
            assert paths("cloud-b") == [1.0]
            assert "took a new revocation list" in robot.log.read_text()
        finally:
            system.close()
