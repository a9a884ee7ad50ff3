from __future__ import annotations

import base64
import binascii
import random
import time
from typing import TYPE_CHECKING

import pytest

from plr.sidecar.doctor.scrub import scrubbed, scrubbed_value

if TYPE_CHECKING:
    from collections.abc import Callable

pytestmark = pytest.mark.audit("ops-14")

KEY = "-----BEGIN EC PRIVATE KEY-----\nMHcCAQEEIPsecretsecret\n-----END EC PRIVATE KEY-----"
HEX = "00112233445566778899aabbccddeeff"


@pytest.mark.parametrize(
    ("text", "secret"),
    [
        (f"a key:\n{KEY}\nafter", "MHcC"),
        ("cut off -----BEGIN PRIVATE KEY-----\nMHcC", "MHcC"),
        ("passphrase: correct horse", "correct"),
        ("PLR_CA_PASSPHRASE=hunter2 plr ca issue", "hunter2"),
        ('{"token": "abc def"}', "abc"),
        ("plr ca issue --passphrase hunter2", "hunter2"),
        ("Authorization: Bearer abc.def.ghi", "abc.def"),
        ("https://alice:hunter2@example.org/x", "hunter2"),
        (f"session {HEX}", HEX),
        ("secret 5Qx9vT0oZb3kLm7pRs2uWy4aCd6eFg8hIj1kLn3mPq5", "5Qx9vT0o"),
        ("v 5Qx9vT0oZb3kLm7/Rs2uWy4aCd6eFg8/Ij1kLn3mPq5dddd/aaaa=", "Rs2uWy4a"),
        (f"key=0x{HEX}", HEX),
        (f"sess_{HEX}", HEX),
        ("v " + ":".join(HEX[n : n + 2] for n in range(0, 32, 2)), "00:11"),
        ("passphrase: correct horse battery staple", "staple"),
        ("plr ca issue --passphrase 'correct horse battery'", "battery"),
        ("argv ['--passphrase', 'correct horse']", "horse"),
        ("openssl ec -passin pass:hunter2 -pass hunter3", "hunter"),
        ("password is hunter2", "hunter2"),
        ("<Password>hunter2</Password>", "hunter2"),
        ('{"password": ["hunter2"]}', "hunter2"),
        ("wifi_psk=hunter2", "hunter2"),
        ("signing_key: hunter2", "hunter2"),
        ("Authorization: Digest username=x, response=hunter2", "hunter2"),
        ("Cookie: a=b; sid=hunter2", "hunter2"),
        ("http://user:p@hunter2@host/", "hunter2"),
        ("http://user:a/hunter2@host/", "hunter2"),
        ("MY_SECRET=\n  hunter2", "hunter2"),
        ("secrets:\n- name: x\n  value: hunter2\n- hunter2\nafter: 1", "hunter2"),
        ("passwords:\n  alice:\n\n    hunter2\n  bob: hunter2", "hunter2"),
        ("password: correct\n  hunter2\n  staple", "hunter2"),
        ('passphrase: "first half\n  hunter2"', "hunter2"),
        ('passphrase: "first half\nhunter2"', "hunter2"),
        ('"token": ["abc",\n"hunter2"]', "hunter2"),
        ('  "token": [\n  "abc",\n  "hunter2"\n  ]', "hunter2"),
        ("password = one \\\nhunter2", "hunter2"),
        ("- password: one\n   hunter2", "hunter2"),
        ("PrivateKey = hunter2", "hunter2"),
        ("a private key hunter2", "hunter2"),
        ("https://u:hunter2 @h", "hunter2"),
        ("udp_port: expected a whole number, got 'hunter2'", "hunter2"),
    ],
)
def test_secrets_are_left_out(text: str, secret: str) -> None:
    assert secret not in scrubbed(text)


@pytest.mark.parametrize(
    "text",
    [
        "wlan0 to cloud-1 (10.11.0.2:24801): up for 5 s",
        "tls_dir: /etc/plr/tls",
        "/opt/plr/lib/python3.11/site-packages/sidecar/A1/doctor/examination.py",
        'plr_datagrams_total{direction="sent",interface="wlan0",kind="data"} 12.0',
        "rekey_after_s: 120",
        "2026-11-25T00:16:56.123456+0000 host plr-sidecar[123]: runtime: path wlan0 to cloud-1 is up after 12 ms",
        "plr-bugreport-robot-1-20261125T001728Z.tar.gz",
        "fogros2-plr 0.1.0+763c7a3440fc, kernel 6.1.0-18-amd64, x86_64-linux-gnu",
        "link/ether 02:42:ac:11:00:02 brd ff:ff:ff:ff:ff:ff inet6 fe80::42:acff:fe11:2/64",
        "std_srvs/srv/SetBool plr_demo_interfaces/srv/PlanPath /warehouse/arm_7/PlanPathToTheNextStation",
        "/etc/plr/tls/key.pem: others may read or change it; do: chmod 640 /etc/plr/tls/key.pem",
        "x.yaml: interface: unknown key; did you mean interfaces?",
    ],
)
def test_what_is_no_secret_stays(text: str) -> None:
    assert scrubbed(text) == text


def test_what_comes_after_a_secret_s_lines_stays() -> None:
    text = "secrets:\n  - hunter2\n  - hunter3\nname: robot-1\nMY_SECRET=\nhunter2\nrole: robot"
    assert scrubbed(text) == (
        "secrets:\n  (left out)\n  (left out)\nname: robot-1\nMY_SECRET=\n(left out)\nrole: robot"
    )


def test_what_follows_a_value_that_goes_on_stays() -> None:
    text = '- password: a\n  name: robot-1\n"token": ["a",\n"b"]\nrole: robot\npassword (x'
    assert scrubbed(text + "\ny" * 300).splitlines()[:6] == [
        "- password (left out)",
        "  name: robot-1",
        '"token (left out)',
        "(left out)",
        "role: robot",
        "password (left out)",
    ]
    assert scrubbed(text + "\ny" * 300).endswith("y\ny")


def test_random_keys_are_left_out() -> None:
    """Of 16 bytes one in a thousand looks like words; of 32 none in 20,000 did."""
    drawn = random.Random(7)
    encodings: list[Callable[[bytes], bytes]] = [base64.b64encode, base64.urlsafe_b64encode, base64.b32encode]
    for encode in [*encodings, binascii.hexlify]:
        for _ in range(200):
            key = encode(drawn.randbytes(32)).decode()
            assert key not in scrubbed(f"a {key} z")


@pytest.mark.parametrize(
    "unit",
    ["a.", "a=b ", "://", "a://@", "-----BEGIN A-----", "-----BEGIN A", "ab:", "aA", "Aa-", " ", "=", "password:\n",
     "password [\n", "://a:b ", "Key", "- ", "a_key ", '"\\', "got '", "\n"],
)  # fmt: skip
def test_time_grows_with_the_length_alone(unit: str) -> None:
    """A line four times as long, and four times as many lines, take no sixteen times as long."""

    def takes_s(text: str) -> float:
        tries = []
        for _ in range(3):
            began = time.process_time()
            scrubbed(text)
            tries.append(time.process_time() - began)
        return min(tries)

    for end in ("", "\n" * (unit != "\n")):
        short, long = ((unit * 1000 + end) * count for count in (8, 32))
        assert takes_s(long) < 12 * takes_s(short) + 0.02


def test_values_by_their_keys() -> None:
    value = {
        "api_key": "abc", "nested": [{"password": "x", "name": "robot-1"}], "rekey_after_s": 120, HEX: 1,
        "tokens": ["a", "b"], "passwords": {"alice": "x"}, "secret": 12345678, "token": None,
    }  # fmt: skip
    assert scrubbed_value(value) == {
        "api_key": "(left out)",
        "nested": [{"password": "(left out)", "name": "robot-1"}],
        "rekey_after_s": 120,
        "(left out)": 1,
        "tokens": "(left out)",
        "passwords": "(left out)",
        "secret": "(left out)",
        "token": None,
    }
