"""A certificate of the fleet's CA names a node; everything else is refused with the reason."""

from __future__ import annotations

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec, ed25519
from cryptography.hazmat.primitives.serialization import Encoding
from cryptography.x509.oid import ExtendedKeyUsageOID

from plr.controlplane.ca import Authority, Validity
from plr.protos.trust.identity import (
    CONTROL_PLANE_DNS,
    MAX_CA_CERTIFICATES,
    MAX_CERTIFICATE_BYTES,
    CertificateError,
    IdentityRole,
    Trust,
)
from tests.support.forged import CA_USAGE, DAY_S, NOW, Recipe, uri


def authority(name: str = "fleet", days: float = 100.0) -> Authority:
    return Authority.create(name, days=days, clock=lambda: NOW)


CA = authority()
TRUST = Trust(CA.ca_pem)
DNS = x509.DNSName(CONTROL_PLANE_DNS)


def reason(der: bytes, trust: Trust = TRUST, now: float = NOW) -> str:
    with pytest.raises(CertificateError) as caught:
        trust.check(der, now)
    assert "\n" not in str(caught.value)
    return caught.value.reason


@pytest.mark.parametrize("role", IdentityRole)
def test_a_certificate_names_its_node(role: IdentityRole) -> None:
    ca = authority()
    issued = ca.issue("node-1", role, days=10)
    identity = Trust(ca.ca_pem).check(issued.certificate_der, NOW)
    assert (identity.name, identity.role) == ("node-1", role)
    assert identity.serial == issued.certificate.serial_number
    assert identity.not_before < NOW < identity.not_after == NOW + 10 * DAY_S


def test_a_recipe_unchanged_is_good() -> None:
    assert TRUST.check(Recipe().der(CA), NOW).name == "robot-1"


def test_another_ca_is_not_believed_even_under_the_same_name() -> None:
    stranger = authority(CA.own.certificate.subject.rfc4514_string().removeprefix("CN="))
    assert stranger.own.certificate.subject == CA.own.certificate.subject
    assert reason(stranger.issue("robot-1", IdentityRole.ROBOT).certificate_der) == "untrusted"


def test_a_certificate_ends_and_begins() -> None:
    ca = authority()
    der = ca.issue("robot-1", IdentityRole.ROBOT, validity=Validity(NOW, NOW + 60)).certificate_der
    trust = Trust(ca.ca_pem)
    assert reason(der, trust, NOW - 1) == "not_yet_valid"
    trust.check(der, NOW)
    trust.check(der, NOW + 60)
    assert reason(der, trust, NOW + 61) == "expired"
    assert trust.identify(der).name == "robot-1"


def test_nothing_outlives_its_ca() -> None:
    ca = authority(days=1)
    der = ca.issue("robot-1", IdentityRole.ROBOT, validity=Validity(NOW, NOW + 10 * DAY_S)).certificate_der
    assert reason(der, Trust(ca.ca_pem), NOW + 2 * DAY_S) == "expired"


def test_a_revoked_certificate_is_refused_and_another_of_the_name_is_not() -> None:
    ca = authority()
    old = ca.issue("robot-1", IdentityRole.ROBOT)
    other = ca.issue("robot-2", IdentityRole.ROBOT)
    ca.revoke("robot-1", x509.ReasonFlags.key_compromise)
    new = ca.issue("robot-1", IdentityRole.ROBOT)
    trust = Trust(ca.ca_pem, ca.crl_pem())
    assert reason(old.certificate_der, trust) == "revoked"
    assert trust.check(new.certificate_der, NOW).name == "robot-1"
    assert trust.check(other.certificate_der, NOW).name == "robot-2"


def test_one_ca_takes_over_from_another() -> None:
    old, new = authority("old"), authority("new")
    first, second = old.issue("robot-1", IdentityRole.ROBOT), new.issue("robot-1", IdentityRole.ROBOT)
    both = Trust(old.ca_pem + new.ca_pem)
    assert both.check(first.certificate_der, NOW).name == both.check(second.certificate_der, NOW).name
    assert reason(first.certificate_der, Trust(new.ca_pem)) == "untrusted"

    old.revoke("robot-1")
    lists = Trust(old.ca_pem + new.ca_pem, old.crl_pem() + new.crl_pem())
    assert reason(first.certificate_der, lists) == "revoked"
    lists.check(second.certificate_der, NOW)


def test_a_ca_can_not_revoke_what_another_one_issued() -> None:
    ca, other = authority("one"), authority("other")
    der = ca.issue("robot-1", IdentityRole.ROBOT).certificate_der
    serial = ca.entries[0].serial
    other.issue("robot-1", IdentityRole.ROBOT)
    entry = other.entries[0]
    other.entries[0] = type(entry)(entry.name, entry.role, serial, entry.not_before, entry.not_after)
    other.revoke("robot-1")
    Trust(ca.ca_pem + other.ca_pem, other.crl_pem()).check(der, NOW)


def test_a_leaf_issues_nothing() -> None:
    leaf = CA.issue("rogue", IdentityRole.ROBOT)
    forged = Recipe().sign(leaf.certificate.subject, leaf.key).public_bytes(Encoding.DER)
    assert reason(forged) == "untrusted"


def test_a_certificate_signed_by_itself_is_refused() -> None:
    recipe = Recipe()
    assert isinstance(recipe.key, ec.EllipticCurvePrivateKey)
    forged = recipe.sign(CA.own.certificate.subject, recipe.key).public_bytes(Encoding.DER)
    assert reason(forged) == "untrusted"


@pytest.mark.parametrize(
    "recipe",
    [
        Recipe(ca=True),
        Recipe(ca=None),
        Recipe(usage=None),
        Recipe(usage=frozenset({"key_encipherment"})),
        Recipe(usage=CA_USAGE | {"digital_signature"}),
        Recipe(purposes=None),
        Recipe(purposes=[ExtendedKeyUsageOID.SERVER_AUTH]),
        Recipe(extra=[x509.UnrecognizedExtension(x509.ObjectIdentifier("1.3.6.1.4.1.99999.1"), b"\x05\x00")]),
        Recipe(hash=hashes.SHA3_256()),
        Recipe(key=ec.generate_private_key(ec.SECP384R1())),
        Recipe(key=ed25519.Ed25519PrivateKey.generate()),
        Recipe(names=[]),
        Recipe(names=[x509.DNSName("robot-1")]),
        Recipe(names=[uri("plr://robot/robot-1"), uri("plr://robot/robot-1")]),
        Recipe(names=[uri("plr://robot/robot-1"), uri("plr://cloud/cloud-1")]),
        Recipe(names=[uri("plr://robot/robot-1"), DNS]),
        Recipe(names=[uri("plr://controlplane/cp")]),
        Recipe(names=[uri("plr://controlplane/cp"), x509.DNSName("elsewhere.example")]),
        Recipe(names=[uri("plr://controlplane/cp"), DNS, x509.DNSName("elsewhere.example")]),
        Recipe(names=[uri("spiffe://robot/robot-1")]),
        Recipe(names=[uri("plr:robot/robot-1")]),
        Recipe(names=[uri("plr://robot")]),
        Recipe(names=[uri("plr://robot/")]),
        Recipe(names=[uri("plr://robot/robot-1/x")]),
        Recipe(names=[uri("plr://robot/robot 1")]),
        Recipe(names=[uri("plr://robot/robot-1\n")]),
        Recipe(names=[uri("plr://robot/../cloud-1")]),
        Recipe(names=[uri("plr://robot/" + "r" * 64)]),
        Recipe(names=[uri("plr://robot/robot%2D1")]),
    ],
    ids=lambda recipe: repr(recipe.names)[-40:],
)
def test_what_is_not_a_nodes_certificate_is_malformed(recipe: Recipe) -> None:
    assert reason(recipe.der(CA)) == "malformed"


@pytest.mark.parametrize("role", ["", "Robot", "root", "robot@robot"])
def test_a_role_that_does_not_exist_is_a_wrong_role(role: str) -> None:
    assert reason(Recipe(names=[uri(f"plr://{role}/robot-1")]).der(CA)) == "wrong_role"


def test_an_extension_that_is_not_critical_may_be_unknown() -> None:
    unknown = x509.UnrecognizedExtension(x509.ObjectIdentifier("1.3.6.1.4.1.99999.1"), b"\x05\x00")
    TRUST.check(Recipe(extra=[unknown], extra_critical=False).der(CA), NOW)


def test_a_long_certificate_is_refused_unread() -> None:
    der = Recipe(extra=[x509.UnrecognizedExtension(x509.ObjectIdentifier("1.3.6.1.4.1.99999.1"), bytes(2000))]).der(CA)
    assert len(der) > MAX_CERTIFICATE_BYTES
    assert reason(der) == "malformed"


def test_trailing_bytes_are_refused() -> None:
    assert reason(Recipe().der(CA) + b"\0") == "malformed"


def pem(recipe: Recipe) -> bytes:
    return recipe.sign(CA.own.certificate.subject, CA.own.key).public_bytes(Encoding.PEM)


@pytest.mark.parametrize(
    "ca_pem",
    [
        b"",
        b"-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n",
        pem(Recipe()),
        pem(Recipe(ca=True)),
        pem(Recipe(ca=None, usage=CA_USAGE)),
        pem(Recipe(ca=False, usage=CA_USAGE)),
        pem(Recipe(ca=True, usage=None)),
        pem(Recipe(ca=True, usage=CA_USAGE, key=ed25519.Ed25519PrivateKey.generate())),
        CA.ca_pem + pem(Recipe()),
        CA.ca_pem * (MAX_CA_CERTIFICATES + 1),
    ],
    # Workers of one run must agree on names, and new keys are made in each.
    ids=map(str, range(10)),
)
def test_what_is_no_ca_is_not_trusted(ca_pem: bytes) -> None:
    with pytest.raises(CertificateError) as caught:
        Trust(ca_pem)
    assert caught.value.reason == "malformed"


def test_a_ca_by_a_recipe_is_one() -> None:
    Trust(pem(Recipe(ca=True, usage=CA_USAGE)))


@pytest.mark.parametrize(
    "crl",
    [b"", b"nothing", CA.ca_pem, CA.crl_pem()[:60] + CA.crl_pem()[-30:]],
    ids=["empty", "no PEM", "another kind", "cut"],
)
def test_what_is_no_revocation_list_is_refused(crl: bytes) -> None:
    with pytest.raises(CertificateError) as caught:
        Trust(CA.ca_pem, crl)
    assert caught.value.reason == "malformed"


def test_a_revocation_list_of_another_ca_is_refused() -> None:
    stranger = authority()
    with pytest.raises(CertificateError) as caught:
        Trust(CA.ca_pem, stranger.crl_pem())
    assert caught.value.reason == "untrusted"


def test_a_list_of_a_ca_that_is_no_longer_believed_may_stay() -> None:
    ca = authority()
    der = ca.issue("robot-1", IdentityRole.ROBOT).certificate_der
    ca.revoke("robot-1")
    for lists in (ca.crl_pem() + authority().crl_pem(), authority().crl_pem() + ca.crl_pem()):
        assert reason(der, Trust(ca.ca_pem, lists)) == "revoked"


def test_a_partial_revocation_list_is_refused() -> None:
    builder = (
        x509.CertificateRevocationListBuilder()
        .issuer_name(CA.own.certificate.subject)
        .last_update(CA.own.certificate.not_valid_before_utc)
        .next_update(CA.own.certificate.not_valid_after_utc)
        .add_extension(x509.CRLNumber(2), critical=False)
        .add_extension(x509.DeltaCRLIndicator(1), critical=True)
    )
    delta = builder.sign(CA.own.key, hashes.SHA256()).public_bytes(Encoding.PEM)
    with pytest.raises(CertificateError) as caught:
        Trust(CA.ca_pem, delta)
    assert caught.value.reason == "malformed"


def test_older_and_missing_lists_are_told_from_newer_ones() -> None:
    ca = authority()
    bare, first = Trust(ca.ca_pem), Trust(ca.ca_pem, ca.crl_pem())
    ca.issue("robot-1", IdentityRole.ROBOT)
    ca.revoke("robot-1")
    second = Trust(ca.ca_pem, ca.crl_pem())
    assert [older.forgets(second) for older in (bare, first)] == [True, True]
    assert bare.forgets(first)
    assert not any(second.forgets(older) for older in (bare, first, second))

    before = ca.crl_pem()
    ca.rotate("next")
    both = Trust(ca.ca_pem, ca.crl_pem())
    assert not both.forgets(second)
    assert Trust(ca.ca_pem, before).forgets(both)
    ca.retire()
    assert not Trust(ca.ca_pem, ca.crl_pem()).forgets(both), "of a CA that is no longer believed nothing is needed"


def test_further_lists_take_nothing_back() -> None:
    ca, other = authority(), authority()
    der = ca.issue("robot-1", IdentityRole.ROBOT).certificate_der
    before = ca.crl_pem()
    ca.revoke("robot-1")
    trust = Trust(ca.ca_pem + other.ca_pem, ca.crl_pem())
    wider = trust.with_revocations(before + other.crl_pem())
    assert reason(der, wider) == "revoked"
    assert [one and one.number for one in trust.lists().values()] == [1, None]
    assert [one and one.number for one in wider.lists().values()] == [1, 0]
    assert Trust(ca.ca_pem + other.ca_pem, wider.crl_pem()).lists() == wider.lists()
    with pytest.raises(CertificateError):
        trust.with_revocations(authority().crl_pem())


def test_lists_without_end_are_not_looked_at() -> None:
    with pytest.raises(CertificateError, match="more than 64 revocation lists"):
        Trust(CA.ca_pem, CA.crl_pem() * 65)


def test_a_certificate_needs_a_list_that_is_new_enough_if_that_is_asked_for() -> None:
    clock = [NOW]
    ca, other = Authority.create(clock=lambda: clock[0]), authority("other")
    der = ca.issue("robot-1", IdentityRole.ROBOT).certificate_der
    ca.publish()
    both = Trust(ca.ca_pem + other.ca_pem, ca.crl_pem())
    both.check(der, NOW + 60.0, 60.0)
    with pytest.raises(CertificateError) as caught:
        both.check(der, NOW + 61.0, 60.0)
    assert caught.value.reason == "list_too_old"
    with pytest.raises(CertificateError, match="is not here"):
        both.check(other.issue("robot-1", IdentityRole.ROBOT).certificate_der, NOW, 60.0)
    assert len(both.too_old(NOW, 60.0)) == 1
    assert len(both.too_old(NOW + 61.0, 60.0)) == 2
    assert not both.too_old(NOW + 1e9, float("inf")) - both.too_old(NOW, 60.0)
    clock[0] = NOW + 100.0
    ca.publish()
    both.with_revocations(ca.crl_pem()).check(der, NOW + 150.0, 60.0)


def test_a_list_of_a_clock_that_is_ahead_is_believed() -> None:
    ahead = Authority.create(clock=lambda: NOW)
    der = ahead.issue("robot-1", IdentityRole.ROBOT).certificate_der
    ahead._clock = lambda: NOW + 3600.0
    ahead.revoke("robot-1")
    with pytest.raises(CertificateError, match="revoked"):
        Trust(ahead.ca_pem, ahead.crl_pem()).check(der, NOW, 60.0)
