"""The CA issues, renews, revokes and hands over; nodes that check with what it gives them see just that."""

from __future__ import annotations

import pytest
from cryptography.x509 import ReasonFlags

from plr.controlplane.ca import Authority, AuthorityError
from plr.controlplane.ca.authority import BACKDATE_S
from plr.controlplane.ca.request import build_request, parse_request
from plr.protos.base.errors import DecodeError
from plr.protos.trust.identity import CertificateError, IdentityRole, Trust

DAY_S = 86_400.0


class Clock:
    def __init__(self) -> None:
        self.now = 1_900_000_000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def ca(clock: Clock) -> Authority:
    return Authority.create(days=100, clock=clock)


def trust(ca: Authority) -> Trust:
    return Trust(ca.ca_pem, ca.crl_pem())


def refusal(ca: Authority, der: bytes, clock: Clock) -> str:
    with pytest.raises(CertificateError) as caught:
        trust(ca).check(der, clock.now)
    return caught.value.reason


def test_clocks_a_few_minutes_slow_find_a_new_certificate_valid(ca: Authority, clock: Clock) -> None:
    der = ca.issue("robot-1", IdentityRole.ROBOT).certificate_der
    trust(ca).check(der, clock.now - BACKDATE_S)


def test_a_name_is_issued_once(ca: Authority) -> None:
    ca.issue("robot-1", IdentityRole.ROBOT)
    with pytest.raises(AuthorityError, match="plr ca renew robot-1"):
        ca.issue("robot-1", IdentityRole.CLOUD)
    assert len(ca.entries) == 1


def test_a_name_whose_certificates_have_ended_is_free(ca: Authority, clock: Clock) -> None:
    ca.issue("robot-1", IdentityRole.ROBOT, days=1)
    clock.now += 2 * DAY_S
    der = ca.issue("robot-1", IdentityRole.CLOUD).certificate_der
    assert trust(ca).check(der, clock.now).role is IdentityRole.CLOUD


@pytest.mark.parametrize("name", ["", "robot 1", "../robot", "-robot", "r" * 64, "robot\n"])
def test_a_bad_name_is_refused(ca: Authority, name: str) -> None:
    with pytest.raises(DecodeError):
        ca.issue(name, IdentityRole.ROBOT)
    assert not ca.entries


def test_no_certificate_is_issued_beyond_the_end_of_the_ca(ca: Authority, clock: Clock) -> None:
    clock.now += 50 * DAY_S
    with pytest.raises(AuthorityError, match="the CA's certificate expires in 50 days"):
        ca.issue("robot-1", IdentityRole.ROBOT, days=51)
    ca.issue("robot-1", IdentityRole.ROBOT, days=50)
    with pytest.raises(AuthorityError, match="the CA's certificate expires"):
        ca.renew("robot-1", days=51)


def test_renewing_makes_another_key_and_leaves_the_old_certificate_in_force(ca: Authority, clock: Clock) -> None:
    old = ca.issue("cloud-1", IdentityRole.CLOUD, days=5)
    clock.now += DAY_S
    new = ca.renew("cloud-1", days=5)
    assert new.key_pem != old.key_pem
    for issued in (old, new):
        identity = trust(ca).check(issued.certificate_der, clock.now)
        assert (identity.name, identity.role) == ("cloud-1", IdentityRole.CLOUD)
    clock.now += 4.5 * DAY_S
    assert refusal(ca, old.certificate_der, clock) == "expired"
    trust(ca).check(new.certificate_der, clock.now)


def test_renewing_can_keep_the_key(ca: Authority) -> None:
    old = ca.issue("cloud-1", IdentityRole.CLOUD)
    assert ca.renew("cloud-1", key=old.key).key_pem == old.key_pem


def test_what_does_not_exist_is_neither_renewed_nor_revoked(ca: Authority) -> None:
    with pytest.raises(AuthorityError, match="plr ca list shows"):
        ca.renew("robot-1")
    ca.issue("robot-7", IdentityRole.ROBOT)
    with pytest.raises(AuthorityError, match="did you mean robot-7"):
        ca.revoke("robt-7")


def test_revoking_ends_every_certificate_of_the_name_and_no_other(ca: Authority, clock: Clock) -> None:
    lost = [ca.issue("robot-1", IdentityRole.ROBOT), ca.renew("robot-1"), ca.renew("robot-1")]
    other = ca.issue("robot-2", IdentityRole.ROBOT)
    before = ca.crl_number
    assert len(ca.revoke("robot-1", ReasonFlags.key_compromise)) == 3
    assert ca.crl_number == before + 1
    assert [refusal(ca, issued.certificate_der, clock) for issued in lost] == ["revoked"] * 3
    trust(ca).check(other.certificate_der, clock.now)
    with pytest.raises(AuthorityError, match="no certificate in force"):
        ca.revoke("robot-1")
    with pytest.raises(AuthorityError, match="is revoked"):
        ca.renew("robot-1")


def test_a_revoked_name_can_be_let_in_again_with_another_certificate(ca: Authority, clock: Clock) -> None:
    lost = ca.issue("robot-1", IdentityRole.ROBOT)
    ca.revoke("robot-1")
    found = ca.issue("robot-1", IdentityRole.ROBOT)
    assert refusal(ca, lost.certificate_der, clock) == "revoked"
    trust(ca).check(found.certificate_der, clock.now)
    ca.renew("robot-1")


def test_a_ca_is_replaced_without_a_moment_in_which_a_node_is_not_believed(ca: Authority, clock: Clock) -> None:
    names = ["robot-1", "cloud-1"]
    shown = {name: ca.issue(name, IdentityRole.ROBOT).certificate_der for name in names}
    believing = dict.fromkeys(names, trust(ca))

    def everyone_believes_everyone() -> None:
        for name in names:
            for other in names:
                assert believing[name].check(shown[other], clock.now).name == other

    ca.rotate("next")
    for name in names:
        believing[name] = trust(ca)
        everyone_believes_everyone()
    with pytest.raises(
        AuthorityError,
        match=r"only a certificate of the former CA; renew or revoke them first: [a-z0-9-]+, [a-z0-9-]+$",
    ):
        ca.retire()
    for name in names:
        shown[name] = ca.renew(name).certificate_der
        everyone_believes_everyone()
    former_der = ca.former[0].issue("rogue", IdentityRole.ROBOT).certificate_der
    ca.revoke("rogue")
    ca.retire()
    for name in names:
        believing[name] = trust(ca)
        everyone_believes_everyone()
        with pytest.raises(CertificateError, match="by another CA"):
            believing[name].check(former_der, clock.now)


def test_a_revocation_reaches_what_a_former_ca_issued(ca: Authority, clock: Clock) -> None:
    old = ca.issue("robot-1", IdentityRole.ROBOT)
    ca.rotate("next")
    new = ca.renew("robot-1")
    assert len(ca.revoke("robot-1")) == 2
    assert refusal(ca, old.certificate_der, clock) == refusal(ca, new.certificate_der, clock) == "revoked"
    ca.retire()
    with pytest.raises(AuthorityError, match="is revoked"):
        ca.renew("robot-1")


def test_a_name_of_a_former_ca_is_taken(ca: Authority) -> None:
    ca.issue("robot-1", IdentityRole.ROBOT)
    ca.rotate("next")
    with pytest.raises(AuthorityError, match="plr ca renew robot-1"):
        ca.issue("robot-1", IdentityRole.ROBOT)


def test_the_revocation_list_changes_only_when_something_is_revoked(ca: Authority, clock: Clock) -> None:
    ca.issue("robot-1", IdentityRole.ROBOT)
    before = ca.crl_pem()
    clock.now += DAY_S
    ca.issue("robot-2", IdentityRole.ROBOT)
    assert ca.crl_pem() == before
    ca.revoke("robot-2")
    after = ca.crl_pem()
    assert after != before
    clock.now += DAY_S
    assert ca.crl_pem() == after


@pytest.mark.audit("sec-12")
def test_lists_are_published_beside_a_former_ca_that_has_ended(ca: Authority, clock: Clock) -> None:
    der = ca.issue("robot-1", IdentityRole.ROBOT, days=10).certificate_der
    clock.now += 20 * DAY_S
    ca.rotate("next", days=1000)
    clock.now += 80 * DAY_S
    ended = ca.former[0].crl_number
    ca.publish()
    lists = [one for one in trust(ca).lists().values() if one is not None]
    assert clock.now in [one.signed_at for one in lists]
    assert ca.former[0].crl_number == ended
    assert refusal(ca, der, clock) == "expired"


@pytest.mark.audit("sec-12")
def test_a_ca_that_has_ended_says_so_when_it_should_publish(ca: Authority, clock: Clock) -> None:
    clock.now += 100 * DAY_S
    with pytest.raises(AuthorityError, match="plr ca rotate"):
        ca.publish()
    trust(ca)


@pytest.mark.audit("sec-11")
def test_a_revoked_key_is_not_kept_when_a_name_is_renewed(ca: Authority) -> None:
    stolen = ca.issue("robot-1", IdentityRole.ROBOT).key
    ca.revoke("robot-1")
    of_another = ca.issue("robot-2", IdentityRole.ROBOT).key
    ca.issue("robot-1", IdentityRole.ROBOT)
    with pytest.raises(AuthorityError, match="was revoked"):
        ca.renew("robot-1", key=stolen)
    with pytest.raises(AuthorityError, match="belongs to robot-2"):
        ca.renew("robot-1", key=of_another)


@pytest.mark.audit("sec-11")
def test_a_revoked_key_does_not_come_back_when_its_ca_has_gone(ca: Authority) -> None:
    stolen = ca.issue("robot-1", IdentityRole.ROBOT).key
    ca.revoke("robot-1")
    ca.issue("robot-1", IdentityRole.ROBOT)
    for name in ("two", "three"):
        ca.rotate(name)
        ca.renew("robot-1")
        ca.retire()
    asked = parse_request(build_request("robot-1", IdentityRole.ROBOT, stolen))
    with pytest.raises(AuthorityError, match="was revoked"):
        ca.sign(asked, renewing=True)
    assert [entry.name for entry in ca.all_entries()] == ["robot-1"]
