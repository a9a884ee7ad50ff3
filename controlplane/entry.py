"""Starts plr-controlplane."""

from __future__ import annotations

from plr.protos.program.entry import end_by_ctrl_c


def main() -> int:
    """Run the program and return its exit code."""
    end_by_ctrl_c()
    from plr.controlplane.__main__ import main

    return main()
