"""Run a program in a process namespace of its own, where it is number 1, as in a container; killed with this one."""

from __future__ import annotations

import os
import sys

if __name__ == "__main__":
    command = ["unshare", "--pid", "--fork", "--kill-child=KILL", *sys.argv[1:]]
    os.execvp(command[0], command)
