"""Brings the lab up, hands out its hosts, links and routers, and takes it down."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Self, TypeVar

from lab import kernel
from lab.drawing import draw
from lab.errors import LabError
from lab.host import DIE_WITH_PARENT, Host, children_of
from lab.link import REPLAY_LEAD_S, Link
from lab.plan import Plan, make_plan
from lab.profile import LinkProfile
from lab.router import translation_rules
from lab.topology import LabConfig, NatSpec
from lab.wire import LineSocket

if TYPE_CHECKING:
    from collections.abc import Mapping
    from types import TracebackType

    from lab.traces import Trace

_REPOSITORY = Path(__file__).resolve().parents[1]
# Building takes half a second on an idle machine.
_BUILD_TIMEOUT_S = 60.0
# SIGKILL takes effect at once; taking down the namespaces' processes takes some tens of ms.
_END_TIMEOUT_S = 20.0
# Log limit of the lab's own processes, which write only when something goes wrong.
_MAX_LOG_BYTES = 1 << 16
_NEEDED_PROGRAMS = ("ip", "nft", "nsenter", "setpriv", "unshare")
_Part = TypeVar("_Part")


class Nat:
    """The NAT router of one interface, made by `Lab`."""

    def __init__(self, spec: NatSpec, router: Host, lab: Lab) -> None:
        self.router = router
        """The router itself, on which `nft` and `tcpdump` can be run."""
        self._spec = spec
        self._lab = lab
        self._rebindings = 0

    @property
    def public_address(self) -> str:
        """The IPv4 address that the internet sees."""
        return self.router.address("wan0", 4)

    def rebind(self) -> None:
        """Forget every mapping, as a carrier does at times: each flow's next packet gets another port.

        Answers to the old port are lost from now on. For IPv6, which is not translated, the firewall
        forgets its flows: nothing comes in until the host sends again.
        """
        self._rebindings += 1
        rules = translation_rules(self._spec, rebindings=self._rebindings)
        done = self.router.run(["nft", "-f", "-"], input=rules)
        if done.returncode:
            raise LabError(f"{self.router.name}: {done.stderr.strip()}")
        self._lab._flush_connections(self.router.name)


class Lab:
    """The lab, as a context manager. The package's docstring shows how to use it.

    Raises:
        LabError: a program is missing, or the kernel refused something; the text says what.
    """

    def __init__(self, config: LabConfig | None = None, *, seed: int = 1) -> None:
        self.config = config if config is not None else LabConfig()
        self.seed = seed
        self._plan: Plan = make_plan(self.config, seed)
        self._machines: dict[str, Host] = {}
        self._links: dict[tuple[str, str], Link] = {}
        self._nats: dict[tuple[str, str], Nat] = {}
        self._holder: subprocess.Popen[bytes] | None = None
        self._inner_pids: dict[str, int] = {}
        self._lifeline: LineSocket | None = None
        # The kernel sends the parent-death signal when the *thread* that started a process ends. So all are started
        # from one thread that lives as long as the lab.
        self._spawner = ThreadPoolExecutor(1, "lab-spawner")
        self._log: IO[bytes] | None = None
        self._lifeline_lock = threading.Lock()
        self.port_kind = ""
        """`tap` or `packet`: how the emulator gets its frames."""

    def __enter__(self) -> Self:
        try:
            self._start()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def hosts(self) -> dict[str, Host]:
        """Robots, clouds and the control host, by name."""
        return {host.name: self._machines[host.name] for host in self.config.hosts}

    @property
    def links(self) -> dict[tuple[str, str], Link]:
        """The emulated links by (host, interface)."""
        return dict(self._links)

    def host(self, name: str) -> Host:
        """Return a host or other machine (`internet`, `robot-wlan0-nat`); raises LabError if there is none."""
        try:
            return self._machines[name]
        except KeyError:
            raise LabError(f"no machine {name!r}, only {', '.join(self._machines)}") from None

    def link(self, interface: str, *, host: str | None = None) -> Link:
        """Return the emulated link of an interface; name the host if several have such an interface."""
        return _find(self._links, interface, host, "emulated link")

    def nat(self, interface: str, *, host: str | None = None) -> Nat:
        """Return the NAT router of an interface; name the host if several have such an interface."""
        return _find(self._nats, interface, host, "NAT router")

    def replay(
        self,
        trace: Trace,
        paths: Mapping[str, str],
        *,
        host: str | None = None,
        start: float | None = None,
        repeat: bool = False,
    ) -> float:
        """Replay a trace on several links with one clock; `paths` maps interface -> path of the trace.

        Returns the `time.monotonic()` of the trace's second 0 (default: `REPLAY_LEAD_S` from now).
        """
        start = time.monotonic() + REPLAY_LEAD_S if start is None else start
        for interface, path in paths.items():
            self.link(interface, host=host).replay(trace, path, start=start, repeat=repeat)
        return start

    def drawing(self) -> str:
        """Return the topology with its addresses, as text."""
        return draw(self.config, self._plan)

    def close(self) -> None:
        """End every process of the lab at once, and so the lab; may be called again."""
        if self._holder is not None:
            for holder in children_of(self._holder.pid):
                with contextlib.suppress(ProcessLookupError):
                    os.kill(holder, signal.SIGKILL)
        if self._lifeline is not None:
            self._lifeline.close()
            self._lifeline = None
        for machine in self._machines.values():
            machine.wake()
        if self._holder is not None:
            # unshare ends when its child does, which the kernel reports only once the whole lab is dead.
            try:
                self._holder.wait(_END_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                self._holder.kill()
                self._holder.wait()
            self._holder = None
        for link in self._links.values():
            link.close()
        for machine in self._machines.values():
            machine.reap()
        if self._log is not None:
            self._log.close()
            self._log = None
        self._spawner.shutdown()

    def _start(self) -> None:
        missing = [program for program in _NEEDED_PROGRAMS if shutil.which(program) is None]
        if missing:
            raise LabError(f"not installed: {', '.join(missing)} (Debian: iproute2, nftables, util-linux)")
        user_namespace = not kernel.can_administer()
        ours, theirs = socket.socketpair()
        self._lifeline = LineSocket(ours)
        link_ends = []
        for link in self._plan.links:
            own_end, emulator_end = socket.socketpair()
            link_ends.append(emulator_end)
            up, down = LinkProfile.from_json(link.up), LinkProfile.from_json(link.down)
            handle = Link(
                link.host,
                link.interface,
                LineSocket(own_end),
                up=up,
                down=down,
                last_words=self._read_log,
            )
            self._links[link.host, link.interface] = handle
        self._log = tempfile.TemporaryFile()
        self._holder = self._spawner.submit(_start_holder, theirs, self._log, user_namespace=user_namespace).result()
        theirs.close()
        ready = self._build(self._plan, link_ends)
        for end in link_ends:
            end.close()
        if "ready" not in ready:
            why = ready.get("error", "its holder died")
            raise LabError(f"the lab could not be built: {why}\n{self._read_log()}")
        self.port_kind = ready["links"][0] if ready["links"] else "none"
        self._inner_pids = ready["pids"]
        outer_pids = _outer_pids(self._holder.pid)
        for name, namespace in self._plan.namespaces.items():
            self._machines[name] = Host(
                name,
                anchor_pid=outer_pids[self._inner_pids[name]],
                user_namespace=user_namespace,
                addresses=self._plan.addresses[name],
                interface_lines=namespace.interface_lines,
                open_socket=partial(self._socket, name),
                spawner=self._spawner,
                environment={"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "NETLAB_HOST": name},
            )
        for spec in self.config.hosts:
            for interface in spec.interfaces:
                if interface.nat is not None:
                    router = self._machines[self._plan.gateways[spec.name][interface.name]]
                    self._nats[spec.name, interface.name] = Nat(interface.nat, router, self)

    def _build(self, plan: Plan, link_ends: list[socket.socket]) -> dict[str, Any]:
        assert self._lifeline is not None
        self._lifeline.settimeout(_BUILD_TIMEOUT_S)
        try:
            descriptors = [end.fileno() for end in link_ends]
            self._lifeline.send_with_descriptors({"links": len(descriptors)}, descriptors)
            self._lifeline.send(plan.to_json())
            return self._lifeline.receive() or {}
        except OSError as error:
            return {"error": str(error)}

    def _read_log(self) -> str:
        if self._log is None:
            return ""
        return os.pread(self._log.fileno(), _MAX_LOG_BYTES, 0).decode(errors="replace").strip()

    def _ask_holder(self, op: str, machine: str, **fields: Any) -> None:
        """Have the holder do something on a machine; the caller holds the lifeline's lock."""
        if self._lifeline is None:
            raise LabError("the lab is closed")
        self._lifeline.send({"op": op, "machine": self._inner_pids[machine], **fields})
        answer = self._lifeline.receive()
        if answer is None or "error" in answer:
            raise LabError(f"{machine}: {op}: {answer['error'] if answer else 'the lab is dead'}")

    def _flush_connections(self, machine: str) -> None:
        with self._lifeline_lock:
            self._ask_holder("flush_connections", machine)

    def _socket(self, machine: str, family: int, kind: int, device: str | None) -> socket.socket:
        with self._lifeline_lock:
            self._ask_holder("socket", machine, family=family, kind=kind, device=device)
            assert self._lifeline is not None
            return socket.socket(fileno=self._lifeline.take_descriptor())


def _start_holder(end: socket.socket, log: IO[bytes], *, user_namespace: bool) -> subprocess.Popen[bytes]:
    command = [
        "unshare",
        "--pid",
        "--mount",
        "--net",
        "--ipc",
        "--uts",
        "--fork",
        "--kill-child",
        "--mount-proc",
    ]
    if user_namespace:
        command += ["--user", "--map-root-user"]
    return subprocess.Popen(
        # -S: it needs only the standard library, and a venv's start-up hooks may be slow.
        [*DIE_WITH_PARENT, *command, sys.executable, "-S", "-m", "lab.holder", str(end.fileno())],
        pass_fds=[end.fileno()],
        env={**os.environ, "PYTHONPATH": str(_REPOSITORY)},
        stdin=subprocess.DEVNULL,
        stdout=log,
        stderr=log,
        start_new_session=True,
    )


def _outer_pids(unshare_pid: int) -> dict[int, int]:
    """Map the PIDs of the holder's children inside the lab to those outside."""
    (holder,) = children_of(unshare_pid)
    pids = {}
    for outer in children_of(holder):
        for line in Path(f"/proc/{outer}/status").read_text().splitlines():
            if line.startswith("NSpid:"):
                pids[int(line.split()[-1])] = outer
    return pids


def _find(table: Mapping[tuple[str, str], _Part], interface: str, host: str | None, what: str) -> _Part:
    found = [part for (owner, name), part in table.items() if name == interface and host in (None, owner)]
    if len(found) != 1:
        there = ", ".join(f"{owner}/{name}" for owner, name in table)
        raise LabError(f"{len(found)} {what}s behind {host or '*'}/{interface}; there are: {there or 'none'}")
    return found[0]
