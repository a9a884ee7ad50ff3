"""Where `plr` begins, and how all programs do: before anything else is imported, which takes a fraction of a second."""

from __future__ import annotations

import os
import signal


def end_by_ctrl_c() -> None:
    """From now on Ctrl-C ends the program as it ends one in C, until `program.ends_quietly` answers for it.

    A program that was started with Ctrl-C ignored, as in the background, goes on ignoring it.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)


def let_the_system_find_names() -> None:
    """From now on gRPC, which looks at this when it is imported, looks names up as other programs of the host do.

    Its own resolver asks a name server for the IPv6 address of what stands in /etc/hosts with an IPv4 one, and waits
    where that server is silent.
    """
    os.environ["GRPC_DNS_RESOLVER"] = "native"


def plr() -> int:
    """Run `plr`; returns its exit code."""
    end_by_ctrl_c()
    let_the_system_find_names()
    from protos.program.command_line import main

    return main()
