"""The one exception that the bridge's parts raise to each other."""

from __future__ import annotations


class RosBridgeError(Exception):
    """A service type that cannot be used, a name that rmw refuses, bytes that are no such message."""
