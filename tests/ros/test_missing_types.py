"""--check-config names the services whose type is not installed here, as far as the last run knows them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from plr.protos.model.ids import NodeName, Role, ServiceName, SessionId, Version
from plr.protos.model.members import Peer, PeerSet, ServiceOffer
from plr.sidecar.__main__ import main
from plr.sidecar.core.rules.service_rule import ServiceRule
from plr.sidecar.ros.graph.missing_types import MAX_MISSING_TYPE_LINES, missing_types
from plr.sidecar.state.file import LastGood, encode_last_good
from plr.sidecar.state.store import LAST_GOOD_FILE

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = [pytest.mark.ros, pytest.mark.audit("ops-4")]

TRIGGER = "std_srvs/srv/Trigger"
ABSENT = "nowhere_msgs/srv/Absent"


def cloud(*offers: tuple[str, str]) -> Peer:
    told = tuple(ServiceOffer(ServiceName(name), kind) for name, kind in offers)
    return Peer(NodeName("cloud-1"), Role.CLOUD, SessionId(1), bytes(range(16)), 1, offers=told)


def rule(pattern: str, kind: str = "") -> ServiceRule:
    return ServiceRule(pattern, deadline_s=0.1, lifetime_s=1.0, type=kind)


def test_only_what_is_carried_and_lacks_its_type_is_named() -> None:
    peers = [cloud(("/plan", ABSENT), ("/where", TRIGGER), ("/not_ours", ABSENT))]
    [line] = missing_types(peers, [rule("/plan"), rule("/where")])
    assert line.startswith(f"/plan, which cloud-1 offered last, cannot be carried: service type {ABSENT} is not inst")
    assert "nowhere_msgs" in line


def test_the_type_that_the_configuration_names_needs_no_server() -> None:
    rules = [rule("/plan", ABSENT), rule("/where", TRIGGER), rule("/maps/*", ABSENT)]
    lines = missing_types([], rules)
    assert [line.partition(" cannot be carried with the type that the configuration names: ")[0] for line in lines] == [
        "/plan",
        "/maps/*",
    ]
    assert all("install the ROS package 'nowhere_msgs'" in line for line in lines)
    # Its servers are not blamed as well, nor for another type, which gets no requests.
    assert missing_types([cloud(("/plan", ABSENT), ("/where", ABSENT))], rules) == lines


def test_a_glob_does_not_fill_the_screen() -> None:
    lines = missing_types(
        [cloud(*((f"/a/{number}", ABSENT) for number in range(MAX_MISSING_TYPE_LINES + 3)))], [rule("/a/*")]
    )
    assert len(lines) == MAX_MISSING_TYPE_LINES + 1
    assert lines[-1] == "and 3 more"


@pytest.mark.parametrize("kept", [True, False])
def test_the_check_warns_of_what_the_disk_tells(tmp_path: Path, capsys: pytest.CaptureFixture[str], kept: bool) -> None:
    config = tmp_path / "sidecar.yaml"
    config.write_text(
        "name: robot-1\nrole: robot\ninsecure: true\ncontrol_plane: 127.0.0.1:1\ninterfaces: [lo]\n"
        f"state_dir: {tmp_path}\nservices: [{{name: /plan, deadline_ms: 100}}]\n"
    )
    last = encode_last_good(LastGood(NodeName("robot-1"), peers=PeerSet(Version(1), 1, (cloud(("/plan", ABSENT)),))))
    (tmp_path / LAST_GOOD_FILE).write_bytes(last if kept else last[:-1])
    assert main(["--config", str(config), "--check-config"]) == 0
    shown = capsys.readouterr()
    assert shown.out == f"{config}: ok\n"
    assert shown.err.startswith("plr-sidecar: warning: /plan, which cloud-1 offered last, ") is kept
    assert (shown.err == "") is not kept
    assert (tmp_path / LAST_GOOD_FILE).exists(), "a check sets nothing aside"
