from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from lab.simulated.sessions import credential_of, private_key, session_of
from plr.protos.base.errors import DecodeError
from plr.protos.model.ids import NodeName, Role, SessionId
from plr.protos.trust.credential import SessionCredential, decode_credential
from plr.sidecar.core.crypto import session as session_module
from plr.sidecar.core.crypto.session import OwnSession
from tests.support.builders import A, B, peer

if TYPE_CHECKING:
    from plr.protos.model.members import Peer

ENDS_AT = 1000.0


def judged(refused: str = "") -> tuple[OwnSession, list[str]]:
    """A session, and whose credentials it looked at; that of `refused` is no good."""
    looked_at: list[str] = []

    def judge(credential: SessionCredential) -> float:
        looked_at.append(credential.name)
        if credential.name == refused:
            raise DecodeError("revoked")
        return ENDS_AT

    own = OwnSession(credential_of("robot-1", Role.ROBOT, 9), private_key("robot-1", 9), judge)
    return own, looked_at


def test_a_credential_is_judged_once_until_trust_changes() -> None:
    own, looked_at = judged()
    keys = own.admit(peer(A))
    assert own.admit(peer(A)) is keys
    own.admit(peer(B))
    assert looked_at == [A, B]
    own.forget_admitted()
    assert own.admit(peer(A)) == keys
    assert looked_at == [A, B, A]


@pytest.mark.audit("sec-6")
def test_a_credential_that_has_ended_is_judged_again() -> None:
    own, looked_at = judged()
    own.admit(peer(A))
    assert own.has_admitted(peer(A).credential)
    assert own.ends_at(peer(A).credential) == ENDS_AT
    assert not own.forget_ended(ENDS_AT)
    assert own.forget_ended(ENDS_AT + 0.1)
    assert not own.has_admitted(peer(A).credential)
    assert own.ends_at(peer(A).credential) < 0
    own.admit(peer(A))
    assert looked_at == [A, A]


def test_a_refused_credential_is_looked_at_every_time() -> None:
    own, looked_at = judged(refused=A)
    for _ in range(2):
        with pytest.raises(DecodeError, match="revoked"):
            own.admit(peer(A))
    assert looked_at == [A, A]


@pytest.mark.parametrize(
    "changes", [{"name": B}, {"role": Role.ROBOT}, {"session": SessionId(5)}, {"incarnation": 5}, {"credential": b""}]
)
def test_a_credential_must_be_the_peers_own(changes: dict[str, object]) -> None:
    own, looked_at = judged()
    own.admit(peer(A))
    stranger: Peer = replace(peer(A), **changes)  # type: ignore[arg-type]  # fields of Peer
    with pytest.raises(DecodeError):
        own.admit(stranger)
    assert looked_at == [A], "and is not judged otherwise"


def test_nobody_is_our_own_name_and_role() -> None:
    own, _ = judged()
    us = replace(
        peer("robot-1", session=9), role=Role.ROBOT, credential=credential_of("robot-1", Role.ROBOT, 9).encode()
    )
    with pytest.raises(DecodeError, match="our own name"):
        own.admit(us)


def test_a_public_key_of_small_order_is_refused() -> None:
    own, _ = judged()
    weak = replace(decode_credential(peer(A).credential), public_key=bytes(32))
    with pytest.raises(DecodeError, match="small order"):
        own.admit(replace(peer(A), credential=weak.encode()))


def test_what_is_remembered_is_capped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session_module, "MAX_ADMITTED", 3)
    own, _ = judged()
    for number in range(1, 10):
        own.admit(peer(f"cloud-{number}", session=number))
        assert len(own._admitted) <= 3


def test_only_the_same_session_may_be_signed_again() -> None:
    own = session_of("robot-1", Role.ROBOT, 9)
    renewed = replace(own.credential, certificate=b"newer", signature=b"newer")
    own.renew(renewed)
    assert own.credential == renewed
    for other in (replace(renewed, session=SessionId(10)), replace(renewed, name=NodeName("robot-2"))):
        with pytest.raises(ValueError, match="another session"):
            own.renew(other)
