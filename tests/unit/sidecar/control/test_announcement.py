"""What a run announces of its addresses."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from plr.controlplane.ca import Authority
from plr.protos.convert import parse_sidecar_message, sidecar_message_to_proto
from plr.protos.model.ids import InterfaceId, InterfaceName, SessionId
from plr.protos.model.members import Candidate, CandidateKind, CandidateSet, InterfaceLabel
from plr.protos.program.tls_files import load_tls_files
from plr.protos.trust.candidate_signature import verify_candidates
from plr.protos.trust.identity import IdentityRole
from plr.sidecar.control.announcement import Announcer

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

pytestmark = pytest.mark.audit("sec-5")

SESSION = SessionId(5)


def candidates(interface: int, count: int) -> list[Candidate]:
    name = InterfaceName(f"eth{interface}")
    return [
        Candidate(InterfaceId(interface), name, CandidateKind.HOST, (f"10.0.{interface}.{number}", 1))
        for number in range(count)
    ]


def labels(interfaces: Iterable[InterfaceName]) -> tuple[InterfaceLabel, ...]:
    return tuple(InterfaceLabel(name, "carrier") for name in dict.fromkeys(interfaces))


def test_each_announcement_is_newer_and_signed_with_the_certificate_of_now(tmp_path: Path) -> None:
    authority = Authority.create()
    for name in ("before", "after"):
        authority.write_tls_dir(tmp_path / name, name, IdentityRole.ROBOT)
    files = load_tls_files(tmp_path / "before")
    announcer = Announcer(SESSION, lambda: files, labels)
    first = announcer.announce(candidates(0, 2))
    files = load_tls_files(tmp_path / "after")
    again = announcer.again()
    last = announcer.announce(())
    assert (first.serial, again.serial, last.serial) == (1, 2, 3)
    assert again.candidates == first.candidates == tuple(candidates(0, 2))
    assert again.labels == first.labels == (InterfaceLabel(InterfaceName("eth0"), "carrier"),)
    before, after = (load_tls_files(tmp_path / name).certificate_der for name in ("before", "after"))
    for said, certificate in ((first, before), (again, after), (last, after)):
        verify_candidates(certificate, SESSION, said.serial, said.candidates, said.signature)


def test_without_certificates_nothing_is_signed() -> None:
    said = Announcer(SESSION, None, labels).announce(candidates(0, 1))
    assert said.signature == b""


def test_no_more_is_announced_than_is_taken_and_that_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    """The best come first. A control plane takes what is announced."""
    announcer = Announcer(SESSION, None, labels)
    said = announcer.announce([*candidates(0, 20), *candidates(1, 8)])
    assert said.candidates == (*candidates(0, 8), *candidates(1, 8))
    announcer.announce([*candidates(0, 21), *candidates(1, 8)])
    assert [record.getMessage() for record in caplog.records] == [
        "eth0: 12 of its addresses are not announced: peers use only a few of each interface"
    ]
    many = announcer.announce(one for interface in range(40) for one in candidates(interface, 8))
    assert len(many.candidates) == 256
    for announced in (said, many):
        parsed = parse_sidecar_message(sidecar_message_to_proto(announced).SerializeToString())
        assert isinstance(parsed, CandidateSet)
        assert parsed == announced


@pytest.mark.audit("ops-13")
def test_what_carries_nothing_is_named_with_its_carrier() -> None:
    def known(interfaces: Iterable[InterfaceName]) -> tuple[InterfaceLabel, ...]:
        return tuple(InterfaceLabel(name, "telekom") for name in interfaces if name == "wwan0")

    names = [InterfaceName(name) for name in ("eth0", "wwan0", "wwan1")]
    announcer = Announcer(SESSION, None, known)
    announcer.announce(candidates(0, 1), names)
    said = announcer.again()
    assert said.down == (InterfaceLabel(names[1], "telekom"), InterfaceLabel(names[2]))
    assert parse_sidecar_message(sidecar_message_to_proto(said).SerializeToString()) == said
