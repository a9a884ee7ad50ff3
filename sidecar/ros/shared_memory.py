"""Says whether the sidecar and the applications can talk at all when they run as different users.

Fast DDS talks through shared memory within a host, unless a profile says otherwise. The segments belong to the user who
made them: a request of another user's program is never answered, and nobody says why.
"""

from __future__ import annotations

import pwd
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

PROC_NET = Path("/proc/net")
REMEDY = (
    "remove ROS_AUTOMATIC_DISCOVERY_RANGE from /etc/plr/sidecar.env, because the unit brings a profile without shared "
    "memory; without the unit, run the sidecar as the applications' user: docs/start/install.md, ROS on the host"
)

_PORT_BASE, _PORTS_OF_A_DOMAIN = 7400, 250
"""UDP ports of a domain (DDSI-RTPS 2.5, 9.6.2)."""
_FIRST_LOGIN, _NOBODY = 1000, 65534
"""Users from 1 to 999, and nobody, belong to services (systemd's UIDS-GIDS)."""
_MOST_NAMED = 4


def is_fast_dds(environment: Mapping[str, str]) -> bool:
    """Return whether the rmw is one of Fast DDS."""
    return (environment.get("RMW_IMPLEMENTATION") or "rmw_fastrtps_cpp").startswith("rmw_fastrtps")


def profile(environment: Mapping[str, str]) -> str | None:
    """Return the file of the Fast DDS profile in use."""
    if not is_fast_dds(environment):
        return None
    return environment.get("FASTRTPS_DEFAULT_PROFILES_FILE") or environment.get("FASTDDS_DEFAULT_PROFILES_FILE") or None


def discovery_range(environment: Mapping[str, str]) -> str:
    """Return the discovery range in force."""
    if environment.get("ROS_LOCALHOST_ONLY") == "1":  # deprecated, but it wins
        return "LOCALHOST"
    return environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE") or "SUBNET"


def users_of_domain(environment: Mapping[str, str], proc_net: Path = PROC_NET) -> frozenset[int]:
    """Return the users whose programs have UDP sockets of the ROS domain on this host."""
    number = environment.get("ROS_DOMAIN_ID") or "0"
    if not (number.isascii() and number.isdigit()):
        return frozenset()
    first = _PORT_BASE + _PORTS_OF_A_DOMAIN * int(number)
    found = set()
    for name in ("udp", "udp6"):
        try:
            lines = (proc_net / name).read_text().splitlines()[1:]
        except OSError:
            continue
        for line in lines:
            words = line.split()
            if int(words[1].rpartition(":")[2], 16) in range(first, first + _PORTS_OF_A_DOMAIN):
                found.add(int(words[7]))
    return frozenset(found)


def problem(environment: Mapping[str, str], user: int, others: Iterable[int]) -> str | None:
    """Return why calls between `user`, who runs the sidecar, and other users get no answer; None if nothing is wrong.

    `others` are the users of programs in the domain. If there are none yet, a service's user expects them.
    """
    reach = discovery_range(environment)
    if not is_fast_dds(environment) or reach == "OFF" or (reach != "LOCALHOST" and profile(environment)):
        return None
    strangers = sorted(set(others) - {user})
    if not strangers and not _is_of_a_service(user):
        return None
    named = ", ".join(map(name_of, strangers[:_MOST_NAMED])) or "other users"
    return (
        "Fast DDS uses shared memory, which works only within one user: the sidecar runs as "
        f"{name_of(user)}, so applications of {named} get no answer"
    )


def _is_of_a_service(user: int) -> bool:
    return 0 < user < _FIRST_LOGIN or user == _NOBODY


def name_of(user: int) -> str:
    """Return a user's name, or the number if it has none."""
    try:
        return pwd.getpwuid(user).pw_name
    except (KeyError, OverflowError):
        return f"user {user}"
