"""Loads service types by name.

The name of a type comes from another machine, so only the form `package/srv/Name` is looked up, never a module of any
other kind.
"""

from __future__ import annotations

import importlib
import re
from dataclasses import dataclass
from typing import Any

from rclpy.type_support import check_for_type_support

from plr.sidecar.ros.errors import RosBridgeError
from plr.sidecar.ros.rcl import MessageType

_SERVICE_TYPE = re.compile(r"([a-z][a-z0-9_]{0,254})/srv/([A-Z][A-Za-z0-9]{0,254})")


class TypeNotInstalledError(RosBridgeError):
    """The type may exist, but not in this environment; installing its package fixes it."""


@dataclass(frozen=True, slots=True)
class ServiceType:
    """A service type of this environment, its type support loaded."""

    name: str
    service: Any
    """The class that rclpy makes services and clients of."""
    request: MessageType
    response: MessageType


def load_service_type(name: str) -> ServiceType:
    """Return the type called `name` ("nav_msgs/srv/GetPlan") or raise RosBridgeError."""
    match = _SERVICE_TYPE.fullmatch(name)
    if match is None:
        raise RosBridgeError(f"{name!r} is not a service type: expected package/srv/Name")
    package, short_name = match.groups()
    importlib.invalidate_caches()  # the package may have been installed since the last try
    try:
        module = importlib.import_module(f"{package}.srv")
        service = getattr(module, short_name)
    # The import runs the package's own code, which may fail in any way.
    except Exception as error:
        raise TypeNotInstalledError(
            f"service type {name} is not installed here ({error}): install the ROS package {package!r}"
            f" (Debian: ros-<distribution>-{package.replace('_', '-')}) or source the workspace that builds it"
        ) from error
    try:
        for generated in (service, service.Request, service.Response):
            check_for_type_support(generated)
    # The type support is generated code that loads shared libraries; it may fail in any way.
    except Exception as error:
        raise TypeNotInstalledError(
            f"service type {name} is installed without usable type support ({error}): reinstall the package {package!r}"
        ) from error
    return ServiceType(name, service, MessageType(service.Request), MessageType(service.Response))
