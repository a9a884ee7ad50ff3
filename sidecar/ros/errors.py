"""Defines the exceptions that the bridge's parts raise to each other."""

from __future__ import annotations


class RosBridgeError(Exception):
    """A service type is unusable, rmw refuses a name, or bytes are no message of the type."""


class RosStartError(Exception):
    """ROS does not start now; the text is one line that says why and, where known, what to do."""
