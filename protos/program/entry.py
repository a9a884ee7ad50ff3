"""Starts `plr`, and prepares all programs before anything else is imported, which takes a fraction of a second."""

from __future__ import annotations

import os
import signal


def end_by_ctrl_c() -> None:
    """Let Ctrl-C end the program as it ends a C program, until `program.endings.ends_quietly` handles it.

    A program started with Ctrl-C ignored, as in the background, goes on ignoring it.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)


def let_the_system_find_names() -> None:
    """Make gRPC, which reads this when it is imported, resolve names as other programs of the host do.

    For a name with only an IPv4 address in /etc/hosts, gRPC's own resolver asks a name server for the IPv6 address, and
    waits if that server is silent.
    """
    os.environ["GRPC_DNS_RESOLVER"] = "native"


def plr() -> int:
    """Run `plr` and return its exit code."""
    end_by_ctrl_c()
    let_the_system_find_names()
    from plr.protos.program.command_line import main

    return main()
