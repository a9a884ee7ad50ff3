"""Defines the one exception that the bridge's parts raise to each other."""

from __future__ import annotations


class RosBridgeError(Exception):
    """A service type is unusable, rmw refuses a name, or bytes are no message of the type."""
