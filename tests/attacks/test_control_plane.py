"""Who knocks at the control plane without the right certificate stays outside, and is counted by the reason.

Every attempt comes over the network from the attacker's host, while requests go on between the others.
"""

from __future__ import annotations

import base64
import json
import socket
import ssl
import sys
import time
from typing import TYPE_CHECKING, Any

import pytest

from lab.attacker.control_client import CONNECT, CONTROL_PLANE_DNS
from lab.system import CONTROL_PORT
from plr.controlplane.ca import Authority, Validity
from plr.controlplane.ca.files import write_tls_files
from plr.protos.model.ids import Role
from plr.protos.trust.identity import IdentityRole
from tests.attacks.world import ATTACKER, World
from tests.support.registrations import registration

if TYPE_CHECKING:
    from pathlib import Path

    from plr.controlplane.ca import Issued

pytestmark = [pytest.mark.netns, pytest.mark.ros, pytest.mark.timeout(180)]

DAY_S = 86_400.0
STATUS = "/plr.v1.Admin/GetStatus"
ROBOT, CLOUD = IdentityRole.ROBOT, IdentityRole.CLOUD
REFUSED = "plr_refused_connections_total"


def target(world: World) -> tuple[str, int]:
    return world.lab.host("control").address(), CONTROL_PORT


class Intruder:
    """The attacker's host, with certificates of its own."""

    def __init__(self, world: World, folder: Path) -> None:
        self.world = world
        self.folder = folder

    def certificate(self, name: str, role: IdentityRole, authority: Authority | None = None, **how: Any) -> Issued:
        """Have a certificate issued, and keep it in this intruder's folder beside the fleet's CA."""
        fleet = self.world.system.authority
        issued = (authority or fleet).issue(name, role, **how)
        write_tls_files(self.folder, issued, fleet.ca_pem, fleet.crl_pem())
        return issued

    def call(self, method: str, *messages: bytes, tls: bool = True, stay_s: float = 5.0) -> dict[str, Any]:
        """Call the control plane from the attacker's host; returns how that ended."""
        host, port = target(self.world)
        argv = [sys.executable, "-m", "lab.attacker.control_client", f"{host}:{port}", method, "--stay", str(stay_s)]
        argv += ["--tls-dir", str(self.folder)] if tls else []
        lines = "".join(base64.b64encode(message).decode() + "\n" for message in messages)
        done = self.world.lab.host(ATTACKER).run(argv, input=lines, timeout=60.0, check=True)
        ended: dict[str, Any] = json.loads(done.stdout)
        return ended

    def handshake(self, context: ssl.SSLContext) -> str:
        """Shake hands with the control plane and wait for a word of it; returns what went wrong, "" if nothing did."""
        with self.world.lab.host(ATTACKER).socket(kind=socket.SOCK_STREAM) as plain:
            plain.settimeout(10.0)
            plain.connect(target(self.world))
            try:
                with context.wrap_socket(plain, server_hostname=CONTROL_PLANE_DNS) as secured:
                    # In TLS 1.3 the client is done before the server has looked at its certificate (RFC 8446, 2).
                    return "" if secured.recv(1) else "closed"
            except (ssl.SSLError, ConnectionError) as error:
                return str(error)


@pytest.fixture
def intruder(world: World, tmp_path: Path) -> Intruder:
    return Intruder(world, tmp_path)


def trusting(world: World) -> ssl.SSLContext:
    """A client's context that believes the fleet's CA, with nothing to show itself."""
    return ssl.create_default_context(cadata=world.system.authority.ca_pem.decode())


def expect_refused(world: World, reason: str, before: float) -> None:
    world.wait_until_counted(REFUSED, before + 1, reason=reason)


NOW = time.time()


@pytest.mark.parametrize(
    ("reason", "validity"),
    [
        ("expired", Validity(NOW - 2 * DAY_S, NOW - DAY_S)),
        ("not_yet_valid", Validity(NOW + DAY_S, NOW + 2 * DAY_S)),
    ],
)
def test_a_certificate_at_the_wrong_time(world: World, intruder: Intruder, reason: str, validity: Validity) -> None:
    issued = intruder.certificate(f"late-{reason.replace('_', '-')}", ROBOT, validity=validity)
    with world.calls():
        before = world.control_counter(REFUSED, reason=reason)
        ended = intruder.call(CONNECT, registration(issued, "robot", Role.ROBOT))
        assert ended["code"] in ("unavailable", "unauthenticated"), ended
        assert ended["answers"] == []
        expect_refused(world, reason, before)


def test_a_certificate_of_another_ca(world: World, intruder: Intruder) -> None:
    issued = intruder.certificate("robot", ROBOT, Authority.create("fleet"))
    with world.calls():
        before = world.control_counter(REFUSED, reason="untrusted")
        ended = intruder.call(CONNECT, registration(issued, "robot", Role.ROBOT))
        assert ended["code"] in ("unavailable", "unauthenticated"), ended
        expect_refused(world, "untrusted", before)


def test_no_certificate(world: World, intruder: Intruder) -> None:
    before = world.control_counter(REFUSED, reason="no_certificate")
    assert intruder.handshake(trusting(world))
    expect_refused(world, "no_certificate", before)


def test_an_older_tls(world: World, intruder: Intruder) -> None:
    intruder.certificate("old-tls", ROBOT)
    context = trusting(world)
    context.load_cert_chain(intruder.folder / "cert.pem", intruder.folder / "key.pem")
    context.maximum_version = ssl.TLSVersion.TLSv1_2
    before = world.control_counter(REFUSED, reason="old_tls")
    assert intruder.handshake(context)
    expect_refused(world, "old_tls", before)


def test_a_downgrade_to_insecure(world: World, intruder: Intruder) -> None:
    issued = intruder.certificate("plain", ROBOT)
    with world.calls():
        before = world.control_counter(REFUSED, reason="not_tls")
        ended = intruder.call(CONNECT, registration(issued, "plain", Role.ROBOT), tls=False)
        assert ended["code"] == "unavailable", ended
        expect_refused(world, "not_tls", before)


@pytest.mark.parametrize("role", [IdentityRole.OPERATOR, IdentityRole.CONTROL_PLANE])
def test_a_stream_of_a_role_that_has_none(world: World, intruder: Intruder, role: IdentityRole) -> None:
    issued = intruder.certificate(f"not-a-{role.value}", role)
    before = world.control_counter(REFUSED, reason="wrong_role")
    ended = intruder.call(CONNECT, registration(issued, f"not-a-{role.value}", Role.ROBOT))
    assert ended["code"] == "permission_denied", ended
    expect_refused(world, "wrong_role", before)


@pytest.mark.parametrize("role", [ROBOT, CLOUD])
def test_administration_by_a_node(world: World, intruder: Intruder, role: IdentityRole) -> None:
    intruder.certificate(f"curious-{role.value}", role)
    before = world.control_counter(REFUSED, reason="wrong_role")
    ended = intruder.call(STATUS, b"")
    assert ended["code"] == "permission_denied", ended
    assert ended["answers"] == []
    expect_refused(world, "wrong_role", before)


def test_a_robot_that_says_it_is_a_cloud(world: World, intruder: Intruder) -> None:
    issued = intruder.certificate("two-faced", ROBOT)
    with world.calls():
        ended = intruder.call(CONNECT, registration(issued, "two-faced", Role.CLOUD))
        assert ended["code"] == "permission_denied", ended
    world.wait_until_counted("plr_registrations_refused_total", 1, reason="wrong_role")


def test_another_nodes_name(world: World, intruder: Intruder) -> None:
    """With a good certificate of its own, it registers as the robot that is there."""
    issued = intruder.certificate("impostor", ROBOT)
    with world.calls():
        ended = intruder.call(CONNECT, registration(issued, "robot", Role.ROBOT))
        assert ended["code"] == "permission_denied", ended
        assert ended["answers"] == []
    world.wait_until_counted("plr_registrations_refused_total", 1, reason="name_mismatch")


def test_a_good_certificate_is_let_in(world: World, intruder: Intruder) -> None:
    """The attempts above fail for the reasons they name: this intruder's tools can do it right."""
    issued = intruder.certificate("honest", ROBOT)
    with world.calls():
        ended = intruder.call(CONNECT, registration(issued, "honest", Role.ROBOT), stay_s=2.0)
    assert ended["code"] == "ok", ended
    assert ended["answers"]


def test_revoked_in_mid_stream(world: World, intruder: Intruder) -> None:
    issued = intruder.certificate("stolen", ROBOT)
    argv_messages = registration(issued, "stolen", Role.ROBOT)
    before = world.control_counter(REFUSED, reason="revoked")
    with world.calls():
        with world.as_soon_as("stolen (robot", lambda: world.revoke("stolen")):
            ended = intruder.call(CONNECT, argv_messages, stay_s=20.0)
        assert ended["answers"], ended
        assert ended["code"] in ("unauthenticated", "unavailable"), ended
        expect_refused(world, "revoked", before)
        ended = intruder.call(CONNECT, argv_messages)
        assert ended["code"] in ("unauthenticated", "unavailable"), ended
        assert ended["answers"] == []
