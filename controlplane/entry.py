"""Starts plr-controlplane."""

from __future__ import annotations

from protos.program.entry import end_by_ctrl_c


def main() -> int:
    """Run the program and return its exit code."""
    end_by_ctrl_c()
    from controlplane.__main__ import main

    return main()
