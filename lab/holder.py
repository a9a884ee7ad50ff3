"""Runs as PID 1 of the lab: builds the plan inside its own namespaces, then holds them until told, or orphaned.

It is started as `python -S -m lab.holder LIFELINE_FD` in fresh PID, mount, network, IPC and UTS namespaces. When PID 1
ends, the kernel ends every process of the lab, and with the processes go their namespaces, interfaces and rules. It
ends when the lifeline closes.

Every machine of the lab is an anchor: a child that holds the namespaces and sleeps.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import traceback
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from lab import kernel
from lab.emulator import LinkEmulator
from lab.errors import LabError
from lab.ports import PacketPort, Port, TapPort
from lab.profile import LinkProfile
from lab.router import flush_connection_tracking
from lab.wire import LineSocket

if TYPE_CHECKING:
    from collections.abc import Callable

# Frames that a TAP holds for the emulator; the default of 1000 is 12 ms at 1 Gbit/s.
_TAP_QUEUE_FRAMES = 4000
_NAMESPACES = kernel.CLONE_NEWNET | kernel.CLONE_NEWNS | kernel.CLONE_NEWUTS | kernel.CLONE_NEWIPC


@dataclass(frozen=True, slots=True)
class _End:
    pid: int
    interface: str
    mac: str


def main(argv: list[str]) -> None:
    """Build the lab and hold it."""
    lifeline_fd = int(argv[0])
    lifeline = LineSocket(socket.socket(fileno=lifeline_fd))
    kernel.set_process_name("lab")
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    hello, plan = lifeline.receive(), lifeline.receive()
    if hello is None or plan is None:
        return
    # Handed over here, not inherited: unshare would inherit them too and keep them open, but the death of an emulator
    # must show as the end of its control socket.
    link_fds = [lifeline.take_descriptor() for _ in range(hello["links"])]
    holder = _Holder(plan, link_fds, lifeline_fd)
    try:
        pids = holder.build()
    except (OSError, LabError, subprocess.SubprocessError) as error:
        lifeline.send({"error": str(error)})
        return
    lifeline.send({"ready": True, "pids": pids, "links": holder.link_kinds})
    signal.signal(signal.SIGCHLD, _reap)
    while (message := lifeline.receive()) is not None:
        try:
            _serve(message, lifeline)
        except OSError as error:
            lifeline.send({"error": str(error)})


def _serve(message: dict[str, Any], lifeline: LineSocket) -> None:
    with kernel.network_namespace_of(message["machine"]):
        if message["op"] == "flush_connections":
            flush_connection_tracking()
            lifeline.send({})
        else:
            with socket.socket(message["family"], message["kind"]) as made:
                if message["device"] is not None:
                    made.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, message["device"].encode())
                lifeline.send_with_descriptors({}, [made.fileno()])


class _Holder:
    def __init__(self, plan: dict[str, Any], link_fds: list[int], lifeline_fd: int) -> None:
        self._plan = plan
        self._link_fds = link_fds
        self._lifeline_fd = lifeline_fd
        self._anchors: dict[str, int] = {}
        self.link_kinds: list[str] = []
        may_open_tun = os.access("/dev/net/tun", os.R_OK | os.W_OK)
        self._use_tap = plan["ports"] == "tap" or (plan["ports"] == "auto" and may_open_tun)

    def build(self) -> dict[str, int]:
        """Build the whole plan; return machine name -> PID of its anchor, as seen inside the lab."""
        for name, namespace in self._plan["namespaces"].items():
            self._anchors[name] = self._fork(partial(self._anchor, namespace), f"machine {name}")
        for segment in self._plan["segments"]:
            self._build_segment(segment)
        for descriptor in self._link_fds:
            os.close(descriptor)
        for name, namespace in self._plan["namespaces"].items():
            with kernel.network_namespace_of(self._anchors[name]):
                lines = [*namespace["ip_lines"]]
                for interface_lines in namespace["interface_lines"].values():
                    lines += interface_lines
                _ip_batch(lines)
                if namespace["ip6_rules"]:
                    _feed(["ip", "-6", "-batch", "-"], "\n".join(namespace["ip6_rules"]) + "\n")
                if namespace["nft_rules"]:
                    _feed(["nft", "-f", "-"], namespace["nft_rules"])
        return self._anchors

    def _fork(self, child: Callable[[], object], what: str, keep: tuple[int, ...] = ()) -> int:
        """Fork `child`, which must call `_tell_ready` through its descriptor 3; wait until it has."""
        reader, writer = os.pipe()
        pid = os.fork()
        if pid == 0:
            try:
                signal.signal(signal.SIGTERM, signal.SIG_DFL)
                for descriptor in (self._lifeline_fd, reader, *self._link_fds):
                    if descriptor not in keep:
                        with contextlib.suppress(OSError):
                            os.close(descriptor)
                self._ready_fd = writer
                child()
                os._exit(0)
            except BaseException:
                print(f"{what}:", file=sys.stderr)
                traceback.print_exc()
                sys.stderr.flush()
                os._exit(1)
        os.close(writer)
        told = os.read(reader, 1)
        os.close(reader)
        if not told:
            raise LabError(f"{what} could not be built")
        return pid

    def _tell_ready(self) -> None:
        os.write(self._ready_fd, b".")
        os.close(self._ready_fd)

    def _anchor(self, namespace: dict[str, Any]) -> NoReturn:
        kernel.set_process_name(f"lab:{namespace['name']}")
        kernel.unshare(_NAMESPACES)
        socket.sethostname(namespace["name"].replace("_", "-"))
        if namespace["is_host"]:
            kernel.mount("lab", "/dev/shm", "tmpfs", options="mode=1777")
            hosts = Path("/dev/shm/hosts")
            hosts.write_text(self._plan["hosts_file"])
            kernel.mount(str(hosts), "/etc/hosts", None, kernel.MS_BIND)
            hosts.unlink()
            with contextlib.suppress(OSError):  # only programs that read /sys/class/net miss it
                kernel.mount("lab", "/sys", "sysfs")
        for key, value in namespace["sysctls"].items():
            Path("/proc/sys", key).write_text(value)
        self._tell_ready()
        while True:
            signal.pause()

    def _build_segment(self, segment: dict[str, Any]) -> None:
        inner, outer = (
            _End(self._anchors[end["namespace"]], end["interface"], end["mac"])
            for end in (segment["inner"], segment["outer"])
        )
        mtu = segment["mtu"]
        link = segment["link"]
        if link is None:
            _make_cable(inner, outer, mtu)
            return
        what = f"link {self._plan['links'][link]['interface']}"
        self._fork(lambda: self._emulate(link, inner, outer, mtu), what, keep=(self._link_fds[link],))
        self.link_kinds.append("tap" if self._use_tap else "packet")

    def _emulate(self, link: int, inner: _End, outer: _End, mtu: int) -> None:
        spec = self._plan["links"][link]
        kernel.set_process_name(f"link:{spec['interface']}")
        make_port = _make_tap if self._use_tap else _make_packet_port
        emulator = LinkEmulator(
            make_port(inner, f"l{link}i", mtu),
            make_port(outer, f"l{link}o", mtu),
            LineSocket(socket.socket(fileno=self._link_fds[link])),
            up=LinkProfile.from_json(spec["up"]),
            down=LinkProfile.from_json(spec["down"]),
            seed=spec["seed"],
        )
        self._tell_ready()
        emulator.run()


def _make_cable(inner: _End, outer: _End, mtu: int) -> None:
    _ip_batch(
        [
            f"link add name {inner.interface} address {inner.mac} mtu {mtu} netns {inner.pid} type veth"
            f" peer name {outer.interface} address {outer.mac} mtu {mtu} netns {outer.pid}"
        ]
    )


def _make_tap(end: _End, _: str, mtu: int) -> Port:
    with kernel.network_namespace_of(end.pid):
        port = TapPort(end.interface)
        _ip_batch([f"link set {end.interface} address {end.mac} mtu {mtu} txqueuelen {_TAP_QUEUE_FRAMES}"])
    return port


def _make_packet_port(end: _End, own_name: str, mtu: int) -> Port:
    _ip_batch(
        [
            f"link add name {own_name} mtu {mtu} type veth"
            f" peer name {end.interface} address {end.mac} mtu {mtu} netns {end.pid}",
            f"link set {own_name} up",
        ]
    )
    Path(f"/proc/sys/net/ipv6/conf/{own_name}/disable_ipv6").write_text("1")
    with kernel.network_namespace_of(end.pid):
        # The emulator sees frames as on the wire: of MTU size, with checksums filled in.
        kernel.disable_offloads(end.interface)
    return PacketPort(own_name)


def _ip_batch(lines: list[str]) -> None:
    _feed(["ip", "-batch", "-"], "\n".join(lines) + "\n")


def _feed(argv: list[str], text: str) -> None:
    done = subprocess.run(argv, input=text, capture_output=True, text=True, check=False)
    if done.returncode:
        raise LabError(f"{' '.join(argv)}: {done.stderr.strip()}\nin:\n{text}")


def _reap(*_: object) -> None:
    """Reap dead processes; orphans of the lab's processes become our children."""
    with contextlib.suppress(ChildProcessError):
        while os.waitpid(-1, os.WNOHANG)[0]:
            pass


if __name__ == "__main__":
    main(sys.argv[1:])
