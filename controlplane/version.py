"""The version of the installed distribution."""

from __future__ import annotations

import importlib.metadata

from protos.model import PROTOCOL_VERSION


def describe(program: str) -> str:
    """One line for --version: the program, its version and the protocol's."""
    try:
        version = importlib.metadata.version("fogros2-plr")
    except importlib.metadata.PackageNotFoundError:
        version = "from source"
    return f"{program} {version} (protocol {PROTOCOL_VERSION})"
