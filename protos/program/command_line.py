"""Runs plr: dispatches each command to the plane that provides it, and loads nothing else.

The operator's commands belong to the control plane, those about the local node to the sidecar. The planes do not import
each other, and a robot need not have what the control plane needs. So each declares its commands as entry points
(`plr.commands` in pyproject.toml).
"""

from __future__ import annotations

import sys
from importlib.metadata import entry_points
from typing import TYPE_CHECKING

from plr.protos.program import endings, extras
from plr.protos.program.exit_codes import EXIT_FAILED

if TYPE_CHECKING:
    from collections.abc import Sequence

GROUP = "plr.commands"
OPERATOR = "operator"
"""The entry point for all commands that have none of their own."""


@endings.ends_quietly("plr")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program and return its exit code."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    commands = {one.name: one for one in entry_points(group=GROUP)}
    name = given[0] if given and given[0] in commands and given[0] != OPERATOR else OPERATOR
    try:
        with extras.required("plr", "controlplane" if name == OPERATOR else "sidecar"):
            run = commands[name].load()
    except KeyError:
        sys.stderr.write("plr: the installation is incomplete: install the same wheel or checkout again\n")
        return EXIT_FAILED
    code: int = run(given if name == OPERATOR else given[1:])
    return code


if __name__ == "__main__":
    sys.exit(main())
