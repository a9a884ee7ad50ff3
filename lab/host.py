"""Controls a machine of a running lab: starts programs on it, looks up its addresses, takes its interfaces down."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import time
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from lab.errors import LabError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from concurrent.futures import Executor

# nsenter needs a few ms to fork; a much longer time means that the machine is overloaded or the lab is gone.
_START_TIMEOUT_S = 10.0
# Kills the program that follows when the thread that started it ends, for whatever reason.
DIE_WITH_PARENT = ("setpriv", "--pdeathsig", "KILL")


class HostProcess(subprocess.Popen[bytes]):
    """A program on a lab host; as `subprocess.Popen`, but signals reach the program itself.

    `pid` is the nsenter that waits for the program outside the lab and ends with it, with the same
    return code (-9 after SIGKILL); `inner_pid` is the program, in the caller's numbering.
    """

    @property
    def inner_pid(self) -> int | None:
        """The program's PID as the caller's /proc shows it; None if it has ended."""
        deadline = time.monotonic() + _START_TIMEOUT_S
        while self.poll() is None:
            children = children_of(self.pid)
            if children:
                return children[0]
            if time.monotonic() > deadline:
                raise LabError(f"{self.args!r}: not started after {_START_TIMEOUT_S} s")
            time.sleep(0.001)
        return None

    def send_signal(self, sig: int) -> None:
        """Send `sig` to the program; does nothing if it has ended."""
        pid = self.inner_pid
        if pid is not None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, sig)
            if sig in (signal.SIGKILL, signal.SIGCONT):
                self.wake()

    def wake(self) -> None:
        """Continue nsenter: it stops itself when the program is stopped, and would not see its end."""
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGCONT)


class Host:
    """A machine of the lab, made by `Lab`."""

    def __init__(
        self,
        name: str,
        *,
        anchor_pid: int,
        user_namespace: bool,
        addresses: Mapping[str, Mapping[int, str]],
        interface_lines: Mapping[str, Sequence[str]],
        environment: Mapping[str, str],
        spawner: Executor,
        open_socket: Callable[[int, int, str | None], socket.socket],
    ) -> None:
        self.name = name
        self.anchor_pid = anchor_pid
        """PID, outside the lab, of the process that holds this machine's namespaces: for `nsenter`."""
        self.environment = dict(environment)
        """Added to the caller's environment for every program on this host."""
        self._user_namespace = user_namespace
        self._addresses = addresses
        self._interface_lines = interface_lines
        self._spawner = spawner
        self._open_socket = open_socket
        self._processes: list[HostProcess] = []

    @property
    def interfaces(self) -> tuple[str, ...]:
        """Names of the interfaces besides lo."""
        return tuple(self._addresses)

    def address(self, interface: str | None = None, family: int = 4) -> str:
        """Return the address of an interface (default: the first), of family 4 or 6.

        Raises:
            LabError: no such interface or family.
        """
        try:
            return self._addresses[self.interfaces[0] if interface is None else interface][family]
        except KeyError:
            raise LabError(f"{self.name}: no IPv{family} address on {interface}") from None

    def enter_command(self, cwd: str | os.PathLike[str] | None = None) -> list[str]:
        """Return a command prefix that runs the command appended to it on this host."""
        target = str(self.anchor_pid)
        command = ["nsenter", "--target", target, "--mount", "--uts", "--ipc", "--net", "--pid"]
        if self._user_namespace:
            command += ["--user", "--preserve-credentials"]
        return [*command, f"--wdns={os.fspath(cwd) if cwd is not None else os.getcwd()}", "--"]

    def popen(
        self,
        argv: Sequence[str | os.PathLike[str]],
        *,
        env: Mapping[str, str | None] | None = None,
        cwd: str | os.PathLike[str] | None = None,
        log_path: str | os.PathLike[str] | None = None,
        stdin: int | IO[Any] | None = subprocess.DEVNULL,
        stdout: int | IO[Any] | None = None,
        stderr: int | IO[Any] | None = None,
        new_session: bool = True,
    ) -> HostProcess:
        """Start a program; it dies with the lab at the latest.

        Args:
            argv: program and arguments, looked up in the caller's PATH and file system.
            env: added to the caller's environment and `environment`; a value of None removes the name.
            cwd: working directory; default: the caller's.
            log_path: append stdout and stderr there; excludes `stdout` and `stderr`.
            stdin, stdout, stderr: as for `subprocess.Popen`; stdin defaults to /dev/null.
            new_session: shield it from a Ctrl-C at the terminal, so that the caller decides in which order
                programs end; False for an interactive program.
        """
        merged: dict[str, str] = {**os.environ, **self.environment}
        for key, value in (env or {}).items():
            if value is None:
                merged.pop(key, None)
            else:
                merged[key] = value
        command = [*DIE_WITH_PARENT, *self.enter_command(cwd), *(os.fspath(word) for word in argv)]
        log = None
        if log_path is not None:
            if stdout is not None or stderr is not None:
                raise ValueError("log_path excludes stdout and stderr")
            log = stdout = Path(log_path).open("ab")
            stderr = subprocess.STDOUT
        try:
            process = self._spawner.submit(
                HostProcess,
                command,
                env=merged,
                stdin=stdin,
                stdout=stdout,
                stderr=stderr,
                start_new_session=new_session,
            ).result()
        finally:
            if log is not None:
                log.close()
        self._processes = [known for known in self._processes if known.returncode is None]
        self._processes.append(process)
        return process

    def run(
        self,
        argv: Sequence[str | os.PathLike[str]],
        *,
        env: Mapping[str, str | None] | None = None,
        cwd: str | os.PathLike[str] | None = None,
        input: str | None = None,
        timeout: float | None = None,
        check: bool = False,
    ) -> subprocess.CompletedProcess[str]:
        """Run a program to its end and capture its output.

        Raises:
            subprocess.TimeoutExpired: it did not end within `timeout` seconds, and was killed.
            subprocess.CalledProcessError: with `check`, its exit code is not 0.
        """
        process = self.popen(
            argv,
            env=env,
            cwd=cwd,
            stdin=subprocess.DEVNULL if input is None else subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        with process:
            try:
                out, err = process.communicate(None if input is None else input.encode(), timeout=timeout)
            except BaseException:
                process.kill()
                raise
        done = subprocess.CompletedProcess(
            [os.fspath(word) for word in argv],
            process.returncode,
            out.decode(errors="replace"),
            err.decode(errors="replace"),
        )
        if check:
            done.check_returncode()
        return done

    def socket(
        self,
        family: int = socket.AF_INET,
        kind: int = socket.SOCK_DGRAM,
        *,
        device: str | None = None,
    ) -> socket.socket:
        """Return a socket of this host for use in the caller's process: what it sends leaves from this host.

        Args:
            family, kind: as for `socket.socket`.
            device: bind it to this interface (SO_BINDTODEVICE).

        Raises:
            LabError: the kernel refused.
        """
        return self._open_socket(family, kind, device)

    def kill(self, process: HostProcess, sig: int = signal.SIGKILL, *, timeout: float = 10.0) -> int:
        """Signal a program, wait for its end and return its return code; raises subprocess.TimeoutExpired."""
        process.send_signal(sig)
        return process.wait(timeout)

    def link_down(self, interface: str) -> None:
        """Run `ip link set INTERFACE down`: its routes vanish, sockets bound to it fail."""
        self.address(interface)
        self.ip_batch([f"link set {interface} down"])

    def link_up(self, interface: str) -> None:
        """Bring an interface up again, with the addresses, routes and neighbours that it had at the start."""
        self.address(interface)
        self.ip_batch(self._interface_lines[interface])

    def ip_batch(self, lines: Sequence[str]) -> None:
        """Run commands of `ip` (without the word `ip`) on this host.

        Raises:
            LabError: a command failed; the text says why.
        """
        done = self.run(["ip", "-batch", "-"], input="\n".join(lines) + "\n")
        if done.returncode:
            raise LabError(f"{self.name}: {done.stderr.strip()}")

    def wake(self) -> None:
        """Continue the nsenters of stopped programs, so that they see the coming end; for `Lab.close`."""
        for process in self._processes:
            if process.poll() is None:
                process.wake()

    def reap(self) -> None:
        """Wait for every program that was started; for `Lab.close`, after the lab's end."""
        for process in self._processes:
            process.wait()
            for pipe in (process.stdin, process.stdout, process.stderr):
                if pipe is not None:
                    pipe.close()
        self._processes.clear()


def children_of(pid: int) -> list[int]:
    """Return the PIDs of a process's children; empty if it has none or is gone."""
    try:
        return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except (FileNotFoundError, ProcessLookupError):
        return []
