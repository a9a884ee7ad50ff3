"""A real control plane process, and real gRPC streams to it."""

from __future__ import annotations

import queue
import re
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Self, TypeVar

import grpc
import yaml

from plr.protos.convert import control_message_from_proto, sidecar_message_to_proto, status_from_proto
from plr.protos.model.ids import Role, Version
from plr.protos.model.mapping import MappingSet
from plr.protos.model.members import CandidateSet, PeerSet, Registration, ServiceSet
from plr.protos.model.stream import Ack, ControlMessage, Drain, Heartbeat, Nack, ResourceKind, SidecarMessage
from plr.protos.plr.v1 import admin_pb2, admin_pb2_grpc, control_pb2, control_pb2_grpc
from plr.protos.trust.credential import Aead, SessionCredential, session_number
from plr.protos.trust.identity import CONTROL_PLANE_DNS
from tests.support.samples import interfaces, offer, registration, use

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey

    from plr.controlplane.ca import Issued
    from plr.protos.model.status import SidecarStatus, SyncState

Message = TypeVar("Message", bound=ControlMessage)

PATIENCE_S = 30.0
"""Only bounds how long a broken test hangs: nothing is asserted about how long things take."""

HEARTBEAT_S = 0.2

_LISTENS = re.compile(r"listens: gRPC (\S+), STUN (.+), metrics (\S+)$")


class ControlPlaneProcess:
    """`python -m plr.controlplane` on free ports of loopback; insecure unless told a `tls_dir`."""

    def __init__(self, folder: Path, **changes: Any) -> None:
        self.settings = {
            **({} if "tls_dir" in changes else {"insecure": True}),
            "listen": "127.0.0.1:0",
            "stun_listen": ["127.0.0.1:0"],
            "stun_servers": ["192.0.2.1:3478"],
            "metrics_listen": "127.0.0.1:0",
            "state_dir": str(folder / "state"),
            "lease_ms": 60_000,
            "report_interval_ms": 100,
            **changes,
        }
        self.config = folder / "controlplane.yaml"
        self.config.write_text(yaml.safe_dump(self.settings))
        self.lines: list[str] = []
        self._process = subprocess.Popen(
            [sys.executable, "-m", "plr.controlplane", "--config", str(self.config)],
            stderr=subprocess.PIPE,
            text=True,
        )
        self.address, self.stun, self.metrics = self._addresses()
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _addresses(self) -> tuple[str, str, str]:
        assert self._process.stderr is not None
        for line in self._process.stderr:
            self.lines.append(line.rstrip())
            found = _LISTENS.search(line.rstrip())
            if found:
                return found[1], found[2], found[3]
        raise AssertionError(f"it did not start: {self.lines}")

    def _read(self) -> None:
        assert self._process.stderr is not None
        self.lines.extend(line.rstrip() for line in self._process.stderr)

    def wait_for_line(self, *parts: str, after: int = 0) -> None:
        """Wait until a line with all these parts is logged, `after` so many others."""
        end = time.monotonic() + PATIENCE_S
        while not any(all(part in line for part in parts) for line in self.lines[after:]):
            assert time.monotonic() < end, f"{parts} not in {self.lines}"
            time.sleep(0.02)

    def status(self) -> dict[str, SidecarStatus]:
        """What it tells operators, by sidecar; of one that is not secured."""
        with grpc.insecure_channel(self.address) as channel:
            answer = admin_pb2_grpc.AdminStub(channel).GetStatus(admin_pb2.GetStatusRequest(), timeout=PATIENCE_S)
        return {found.peer.name: found for found in status_from_proto(answer)}

    def wait_for_state(self, name: str, state: SyncState) -> SidecarStatus:
        """Wait until a sidecar's peers are in this state; an ack is on its way for a moment."""
        end = time.monotonic() + PATIENCE_S
        while True:
            found = self.status().get(name)
            if found is not None and found.peers.state is state:
                return found
            assert time.monotonic() < end, f"{name} is {found}"
            time.sleep(0.02)

    def reload(self, **changes: Any) -> None:
        """Change the configuration, and tell it."""
        self.settings.update(changes)
        self.config.write_text(yaml.safe_dump(self.settings))
        self._process.send_signal(signal.SIGHUP)

    def send_signal(self, number: signal.Signals) -> None:
        """Send a signal."""
        self._process.send_signal(number)

    def stop(self, number: signal.Signals = signal.SIGTERM) -> int:
        """Send a signal and return the exit code."""
        self._process.send_signal(number)
        code = self._process.wait(PATIENCE_S)
        self._reader.join()
        assert self._process.stderr is not None
        self._process.stderr.close()
        return code

    def stop_flawless(self) -> None:
        """Stop it; neither that nor anything before went wrong."""
        assert self.stop() == 0
        bad = [number for number, line in enumerate(self.lines) if "Traceback" in line or " ERROR " in line]
        assert not bad, self.lines[bad[0] :]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process.poll() is None:
            self.stop(signal.SIGKILL)
        else:
            self._reader.join()


@dataclass(frozen=True, slots=True)
class Secured:
    """A client's certificate with its key, and the CA that it trusts."""

    issued: Issued
    ca_pem: bytes

    def claim(self, said: Registration) -> Registration:
        """The registration with the credential that belongs to it, and the session that this is of."""
        said = with_own_session(said)
        return replace(said, credential=credential_of(said, self.issued.certificate_der, self.issued.key))


def with_own_session(said: Registration) -> Registration:
    """The registration with the session that belongs to its credential."""
    return replace(said, session=session_number(said.name, said.role, _public_key_of(said)))


def _public_key_of(said: Registration) -> bytes:
    return said.incarnation.to_bytes(32, "big")


def credential_of(said: Registration, certificate: bytes, key: EllipticCurvePrivateKey) -> bytes:
    """What a sidecar that registers so says of its session; of no use for datagrams."""
    public_key = _public_key_of(said)
    own = SessionCredential(
        said.name, said.role, said.session, said.incarnation, public_key, Aead.AES_256_GCM, certificate
    )
    return own.sign(key).encode()


def open_channel(address: str, secured: Secured | None) -> grpc.Channel:
    """A channel of its own connection."""
    options = (
        ("grpc.ssl_target_name_override", CONTROL_PLANE_DNS),
        ("grpc.use_local_subchannel_pool", 1),
        ("grpc.enable_retries", 0),
    )
    if secured is None:
        return grpc.insecure_channel(address, options)
    issued = secured.issued
    credentials = grpc.ssl_channel_credentials(secured.ca_pem, issued.key_pem, issued.certificate_pem)
    return grpc.secure_channel(address, credentials, options)


class Stream:
    """One control stream: what is put in goes out, what comes in waits in a queue."""

    def __init__(self, address: str, secured: Secured | None = None) -> None:
        self._channel = open_channel(address, secured)
        self._outgoing: queue.SimpleQueue[control_pb2.SidecarMessage | None] = queue.SimpleQueue()
        self._incoming: queue.SimpleQueue[ControlMessage | grpc.RpcError | None] = queue.SimpleQueue()
        stub = control_pb2_grpc.ControlPlaneStub(self._channel)
        self._call: Any = stub.Connect(iter(self._outgoing.get, None))
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def _read(self) -> None:
        try:
            for message in self._call:
                self._incoming.put(control_message_from_proto(message))
            self._incoming.put(None)
        except grpc.RpcError as error:
            self._incoming.put(error)

    def send(self, message: SidecarMessage) -> None:
        self._outgoing.put(sidecar_message_to_proto(message))

    def send_raw(self, message: control_pb2.SidecarMessage) -> None:
        """Send what no sidecar would."""
        self._outgoing.put(message)

    def next(self) -> ControlMessage:
        """The next message; the lease is renewed while waiting for it."""
        end = time.monotonic() + PATIENCE_S
        while True:
            try:
                message = self._incoming.get(timeout=HEARTBEAT_S)
                break
            except queue.Empty:
                assert time.monotonic() < end, "nothing came"
                self.beat()
        assert message is not None, "the stream ended"
        if isinstance(message, grpc.RpcError):
            raise message
        return message

    def expect(self, kind: type[Message], condition: Callable[[Message], bool] = lambda message: True) -> Message:
        """The next message of this type that meets the condition; others are passed over."""
        while True:
            message = self.next()
            if isinstance(message, kind) and condition(message):
                return message

    def quiet_for(self, seconds: float) -> bool:
        """Whether nothing comes for that long."""
        try:
            self._incoming.get(timeout=seconds)
        except queue.Empty:
            return True
        return False

    def end(self) -> tuple[grpc.StatusCode, str]:
        """Wait until the control plane ends the stream; returns the status."""
        while True:
            message = self._incoming.get(timeout=PATIENCE_S)
            if message is None or isinstance(message, grpc.RpcError):
                return self._call.code(), self._call.details()

    def beat(self) -> None:
        """Renew the lease; of no use before registration."""

    def half_close(self) -> None:
        """Say nothing more."""
        self._outgoing.put(None)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._outgoing.put(None)
        self._call.cancel()
        self._thread.join()
        self._channel.close()


class Sidecar(Stream):
    """A stream on which a sidecar registered."""

    def __init__(self, address: str, said: Registration, secured: Secured | None = None) -> None:
        super().__init__(address, secured)
        said = said if secured is None else secured.claim(said)
        self.registration = said
        self.send(said)

    def beat(self) -> None:
        self.send(Heartbeat())

    def __exit__(self, *_: object) -> None:
        """Leave, so that the next test finds nobody here; a stream that is ended already stays so."""
        self.send(Drain())
        self.half_close()
        self._thread.join(PATIENCE_S)
        super().__exit__()

    def kill(self) -> None:
        """Go without a word, as after kill -9."""
        self._call.cancel()
        self._thread.join()

    def ack(self, message: PeerSet | MappingSet) -> None:
        self.send(Ack(_resource(message), message.version, message.nonce))

    def nack(self, message: PeerSet | MappingSet, error: str, in_force: int = 0) -> None:
        self.send(Nack(_resource(message), Version(in_force), message.nonce, error))

    def peers(self, *names: str) -> PeerSet:
        """Wait for the set of exactly these peers, and acknowledge it."""
        found = self.expect(PeerSet, lambda message: {peer.name for peer in message.peers} == set(names))
        self.ack(found)
        return found

    def mapping(self, *servers: str) -> MappingSet:
        """Wait for a mapping of one service to exactly these servers, and acknowledge it."""

        def fits(message: MappingSet) -> bool:
            return [sorted(a.server for a in service.assignments) for service in message.services] == [sorted(servers)]

        found = self.expect(MappingSet, fits)
        self.ack(found)
        return found


def _resource(message: PeerSet | MappingSet) -> ResourceKind:
    return ResourceKind.PEERS if isinstance(message, PeerSet) else ResourceKind.MAPPING


def cloud(address: str, name: str, secured: Secured | None = None, **changes: Any) -> Sidecar:
    """A cloud that offers /plan."""
    sidecar = Sidecar(address, registration(name, Role.CLOUD, **changes), secured)
    sidecar.send(CandidateSet(interfaces("eth0")))
    sidecar.send(ServiceSet((offer(),)))
    return sidecar


def robot(address: str, name: str = "robot", secured: Secured | None = None, **changes: Any) -> Sidecar:
    """A robot that uses /plan over wlan0 and wwan0."""
    sidecar = Sidecar(address, registration(name, Role.ROBOT, **changes), secured)
    sidecar.send(CandidateSet(interfaces("wlan0", "wwan0")))
    sidecar.send(ServiceSet((), (use(),)))
    return sidecar
