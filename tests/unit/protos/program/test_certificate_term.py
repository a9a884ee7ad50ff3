"""What a node's owner learns about its certificate, and what the programs do then."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING

import pytest

from plr.controlplane.__main__ import main as control_plane
from plr.controlplane.ca import Authority
from plr.controlplane.ca.authority import AuthorityError
from plr.controlplane.ca.certificates import Validity
from plr.protos.program import tls_advice
from plr.protos.program.certificate_term import SOON_S, term_problem
from plr.protos.program.tls_files import load_tls_files
from plr.protos.trust.identity import IdentityRole
from plr.sidecar.__main__ import main as sidecar

if TYPE_CHECKING:
    from pathlib import Path

DAY_S = 86_400.0


@pytest.fixture
def ca() -> Authority:
    return Authority.create()


@pytest.mark.parametrize(
    ("left_s", "in_force", "said"),
    [
        (SOON_S + 1, None, ""),
        (SOON_S - 1, True, "cert.pem: expires in 7 days; renew it beside the CA, with: plr ca renew robot-1, and"),
        (90_000.0, True, "cert.pem: expires in 25 hours; "),
        (100.0, True, "cert.pem: expires in 100 seconds; "),
        (
            -60.0,
            False,
            "cert.pem: nobody talks to this node: the certificate of robot-1 expired 60 seconds ago; renew",
        ),
        (-864_006.0, False, "expired 10 days ago; renew"),
        (math.inf, False, "not valid for another 100 seconds; set this host's"),
    ],
)
def test_the_terms_of_a_certificate(
    tmp_path: Path, ca: Authority, left_s: float, in_force: bool | None, said: str
) -> None:
    ca.write_tls_dir(tmp_path / "tls", "robot-1", IdentityRole.ROBOT)
    files = load_tls_files(tmp_path / "tls")
    now = files.identity.not_before - 100.0 if math.isinf(left_s) else files.identity.not_after - left_s
    problem = term_problem(files, now)
    assert (problem and problem.in_force) == in_force
    assert said in (problem.text if problem else "")


def test_a_revoked_one_is_told_so(tmp_path: Path, ca: Authority) -> None:
    ca.write_tls_dir(tmp_path / "tls", "robot-1", IdentityRole.ROBOT)
    ca.revoke("robot-1")
    (tmp_path / "tls" / "crl.pem").write_bytes(ca.crl_pem())
    files, now = load_tls_files(tmp_path / "tls"), time.time()
    problem = term_problem(files, now)
    assert problem is not None
    assert not problem.in_force
    refused = tls_advice.explain("Socket closed", files, now) or ""
    for text in (problem.text, refused):
        assert "robot-1 is revoked" in text
        assert "; let it in again beside the CA, with: plr ca issue robot-1 --role" in text
    # That is what the CA takes then.
    with pytest.raises(AuthorityError):
        ca.renew("robot-1")
    ca.issue("robot-1", IdentityRole.ROBOT)


@pytest.mark.audit("ops-3")
@pytest.mark.parametrize("role", [IdentityRole.ROBOT, IdentityRole.CONTROL_PLANE])
@pytest.mark.parametrize("left_days", [-3.0, 2.0, 300.0])
def test_a_configuration_with_an_ended_certificate_is_refused_and_one_that_ends_soon_warned_of(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], role: IdentityRole, left_days: float
) -> None:
    now = time.time()
    ca = Authority.create(clock=lambda: now - 400 * DAY_S)
    term = now - 20 * DAY_S, now + left_days * DAY_S + 60.0
    ca.write_tls_dir(tmp_path / "tls", "node-1", role, validity=Validity(*term))
    config = tmp_path / "config.yaml"
    robot = "control_plane: 192.0.2.1:50051\nservices: [{name: /plan, deadline_ms: 100}]\n"
    others = "stun_servers: [192.0.2.1:3478]\n"
    config.write_text(f"tls_dir: {tmp_path}/tls\n" + (robot if role is IdentityRole.ROBOT else others))
    main, name = (sidecar, "plr-sidecar") if role is IdentityRole.ROBOT else (control_plane, "plr-controlplane")
    code = main(["--config", str(config), "--check-config"])
    shown = capsys.readouterr()
    assert code == (2 if left_days < 0 else 0)
    assert shown.out == ("" if left_days < 0 else f"{config}: ok\n")
    if left_days < 0:
        assert shown.err.startswith(
            f"{name}: {tmp_path}/tls/cert.pem: nobody talks to this node: the certificate of node-1 expired "
        )
        assert shown.err.count("\n") == 1
    elif left_days < 7:
        assert shown.err.startswith(f"{name}: warning: {tmp_path}/tls/cert.pem: expires in 2 days; renew it")
    else:
        assert shown.err == ""
