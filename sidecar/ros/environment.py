"""Says whether ROS 2 can be used here, in words for the node's operator, before rclpy is loaded.

rclpy ends the whole process if RMW_IMPLEMENTATION names one it was not built with, and Fast DDS does if the domain's
ports are too high. Both explain it in their own terms, from deep inside. So the variables are checked first, and where
that could happen, rclpy is tried in another process.
"""

from __future__ import annotations

import importlib.machinery
import importlib.util
import os
import platform
import re
import subprocess
import sys
import time
from typing import TYPE_CHECKING

from plr.sidecar.ros import static_peers

if TYPE_CHECKING:
    from collections.abc import Mapping

MAX_DOMAIN_ID = 232
"""DDS derives UDP ports from the domain's number; higher numbers give no valid ports (DDSI-RTPS 2.5, 9.6.2)."""
DEFAULT_RMW = "rmw_fastrtps_cpp"
"""Default of ROS Jazzy; it comes with every rclpy, so naming it requires no trial at each start."""
SET_CLOCK = "set it: timedatectl set-ntp true, or date -s"
TRY_TIMEOUT_S = 60.0
"""Loading rclpy takes half a second on an idle machine."""

LAST_SECOND = 1 << 31
"""From this time on (s since 1970), Fast DDS makes no node: its seconds have 32 bits (DDSI-RTPS 2.5, 9.3.2)."""

_TRY = "import rclpy; rclpy.init(args=['--ros-args', '--disable-external-lib-logs']); {}rclpy.shutdown()"
_MAKE_NODE = (
    "rclpy.create_node('plr_check', use_global_arguments=False, enable_rosout=False, start_parameter_services=False); "
)
_NO_NODE = "error creating node"
_C_PART = "_rclpy_pybind11"
_MAX_SAID_CHARACTERS = 300
_NUMBER = re.compile(r"[0-9]{1,9}")
_EXCEPTION = re.compile(r"[\w.]*Error: ")
_LACKS_A_LIBRARY = "cannot open shared object file"


def problem(environment: Mapping[str, str] = os.environ, *, thorough: bool = False) -> str | None:
    """Return one line on what keeps ROS 2 from working here and what to do, or None if nothing was found.

    `thorough` tries rclpy in any case, with a node, which takes about a second.
    """
    domain = environment.get("ROS_DOMAIN_ID", "")
    if domain and not (_NUMBER.fullmatch(domain) and int(domain) <= MAX_DOMAIN_ID):
        return f"ROS_DOMAIN_ID: expected a number from 0 to {MAX_DOMAIN_ID}, got {domain[:_MAX_SAID_CHARACTERS]!r}"
    rclpy = importlib.util.find_spec("rclpy")
    if rclpy is None:
        return (
            f"ROS 2's rclpy is missing for {sys.executable}: with ROS from apt, first source /opt/ros/jazzy/setup.bash "
            "(for the unit: /etc/plr/sidecar.env, deploy/README.md); without it, " + _without_apt(platform.machine())
        )
    folders = list(rclpy.submodule_search_locations or ())
    if importlib.machinery.PathFinder.find_spec(_C_PART, folders) is None:
        return (
            f"ROS 2's rclpy in {' '.join(folders)} was not built for {sys.executable}, which is Python "
            f"{sys.version_info.major}.{sys.version_info.minor}: create the environment with ROS's own Python; for ROS "
            "from apt: /usr/bin/python3 -m venv --system-site-packages (docs/start/install.md, ROS from apt)"
        )
    rmw = environment.get("RMW_IMPLEMENTATION", "")
    if not thorough and rmw in ("", DEFAULT_RMW):
        return None
    said = _try(environment, thorough=thorough)
    if said is None:
        return None
    if rmw and rmw != DEFAULT_RMW and _NO_NODE not in said:
        return (
            f"RMW_IMPLEMENTATION: {rmw!r} is not installed here; unset it to use {DEFAULT_RMW}, or install it "
            "with ROS from apt: ros-jazzy-" + rmw.replace("_", "-")
        )
    if _LACKS_A_LIBRARY in said:
        said += (
            "; with ROS from apt, first source /opt/ros/jazzy/setup.bash (for the unit: LD_LIBRARY_PATH in "
            "/etc/plr/sidecar.env, deploy/README.md)"
        )
    return not_started(said, time.time())


def not_started(said: str, now_wall: float) -> str:
    """Return one line on why ROS does not start, and what to do; `said` is what rclpy says."""
    if _NO_NODE in said and now_wall >= LAST_SECOND:
        return clock_problem(now_wall)
    line = "".join(char for char in " ".join(said.split()) if char.isprintable())[:_MAX_SAID_CHARACTERS]
    return f"ROS 2 does not start here: {line}"


def clock_problem(now_wall: float) -> str:
    """Return one line on a clock that is too far ahead for ROS."""
    return (
        f"the clock says {time.strftime('%Y-%m-%d', time.gmtime(now_wall))}, and Fast DDS works only until 2038-01-19; "
        f"{SET_CLOCK}"
    )


def _without_apt(machine: str) -> str:
    """Return what to do on a `machine` (uname's name for it) that has no ROS from apt yet."""
    if machine == "x86_64":
        return "in the checkout: pip install '.[ros]'"
    return f"install it: it has no wheel for {machine} (docs/start/install.md, ROS from apt)"


def _try(environment: Mapping[str, str], *, thorough: bool) -> str | None:
    """Return the most telling line of what rclpy says when it does not start, or None if it starts."""
    argv = [sys.executable, "-c", _TRY.format(_MAKE_NODE if thorough else "")]
    # The sidecar leaves these peers out too.
    environment = static_peers.without(environment, static_peers.unresolvable(environment))
    try:
        done = subprocess.run(  # noqa: S603  (our own interpreter and text)
            argv, env=environment, capture_output=True, text=True, timeout=TRY_TIMEOUT_S, check=False
        )
    except subprocess.TimeoutExpired:
        return f"rclpy did not start within {TRY_TIMEOUT_S:.0f} s"
    except OSError as error:
        return f"{sys.executable} cannot be run by this user: {error.strerror or error}"
    if done.returncode == 0:
        return None
    lines = [line.strip() for line in done.stderr.splitlines() if line.strip()] or [f"it ends with {done.returncode}"]
    # In a traceback, the first line of the last exception says what is wrong; rcl's own message is a single line.
    said = next((line for line in reversed(lines) if _EXCEPTION.match(line)), lines[-1])
    return "".join(char for char in said if char.isprintable())[:_MAX_SAID_CHARACTERS]
