"""When users cannot talk over Fast DDS, and who is in a domain."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from plr.sidecar.ros import shared_memory

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.audit("ops-14")

LOCALHOST = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
PROFILE = {"FASTRTPS_DEFAULT_PROFILES_FILE": "/etc/plr/fastdds.xml"}
PLR = 987


@pytest.mark.parametrize(
    ("environment", "user", "others", "wrong"),
    [
        (LOCALHOST, PLR, (), True),
        (LOCALHOST | PROFILE, PLR, (), True),
        (LOCALHOST, 1000, (1000, 0), True),
        (LOCALHOST, 0, (1000,), True),
        (LOCALHOST, 1000, (1000,), False),
        (LOCALHOST, 0, (), False),
        ({}, PLR, (), True),
        ({"ROS_LOCALHOST_ONLY": "1"} | PROFILE, PLR, (), True),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "SYSTEM_DEFAULT"} | PROFILE, PLR, (0, 1000), False),
        (LOCALHOST | {"RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp"}, PLR, (0,), False),
    ],
)
def test_which_users_are_kept_apart(
    environment: dict[str, str], user: int, others: tuple[int, ...], wrong: bool
) -> None:
    assert (shared_memory.problem(environment, user, others) is not None) == wrong


def test_the_users_of_a_domain_are_those_of_its_sockets(tmp_path: Path) -> None:
    head = "  sl  local_address rem_address   st tx_queue rx_queue tr tm->when retrnsmt   uid  timeout inode\n"

    def line(port: int, user: int) -> str:
        return f"  1: 00000000:{port:04X} 00000000:0000 07 00000000:00000000 00:00000000 00000000 {user} 0 1 2 0 0\n"

    (tmp_path / "udp").write_text(head + line(7410, 0) + line(7660, 1000) + line(7899, 1001) + line(7900, 5))
    assert shared_memory.users_of_domain({}, tmp_path) == {0}
    assert shared_memory.users_of_domain({"ROS_DOMAIN_ID": "1"}, tmp_path) == {1000, 1001}
    assert shared_memory.users_of_domain({"ROS_DOMAIN_ID": "x"}, tmp_path) == frozenset()
