"""Service types by name, and messages to and from bytes (CDR with its 4-byte encapsulation header).

The name of a type comes from another machine, so only the form `package/srv/Name` is looked up: never a module of
any other kind.
"""

from __future__ import annotations

import importlib
import re
from dataclasses import dataclass
from typing import Any

from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.type_support import check_for_type_support

from sidecar.ros.errors import RosBridgeError

_SERVICE_TYPE = re.compile(r"([a-z][a-z0-9_]{0,254})/srv/([A-Z][A-Za-z0-9]{0,254})")


class TypeNotInstalledError(RosBridgeError):
    """The type may exist, but not in this environment; installing its package cures it."""


@dataclass(frozen=True, slots=True)
class ServiceType:
    """A service type of this environment with its type support loaded."""

    name: str
    service: Any
    request: Any
    response: Any


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
    except (ImportError, AttributeError) as error:
        raise TypeNotInstalledError(
            f"service type {name} is not installed here ({error}): install the ROS package {package!r}"
            f" (Debian: ros-<distribution>-{package.replace('_', '-')}) or source the workspace that builds it"
        ) from error
    try:
        for generated in (service, service.Request, service.Response):
            check_for_type_support(generated)
    # The type support is generated code that loads shared libraries: it fails in ways of its own.
    except Exception as error:
        raise TypeNotInstalledError(
            f"service type {name} is installed without usable type support ({error}): reinstall the package {package!r}"
        ) from error
    return ServiceType(name, service, service.Request, service.Response)


def serialize(message: Any, message_type: Any) -> bytes:
    """Return the bytes of `message`, or raise RosBridgeError when a field holds what cannot be serialised."""
    try:
        payload: bytes = _rclpy.rclpy_serialize(message, message_type)
    except (_rclpy.RMWError, _rclpy.RCLError, TypeError, ValueError) as error:
        raise RosBridgeError(f"cannot serialise {message_type.__name__}: {error}") from error
    return payload


def deserialize(payload: bytes, message_type: Any) -> Any:
    """Return the message in `payload`, or raise RosBridgeError.

    The type support checks lengths against the bytes that are there, so hostile bytes neither crash nor make it
    allocate more than a small multiple of their size (tests/ros/test_hostile_bytes.py).
    """
    try:
        return _rclpy.rclpy_deserialize(payload, message_type)
    except (_rclpy.RMWError, _rclpy.RCLError, TypeError, ValueError) as error:
        raise RosBridgeError(f"the bytes are not a {message_type.__name__}: {error}") from error
