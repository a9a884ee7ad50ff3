from __future__ import annotations

import pytest

from sidecar.doctor.scrub import scrubbed, scrubbed_value

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
    ],
)
def test_what_is_no_secret_stays(text: str) -> None:
    assert scrubbed(text) == text


def test_values_by_their_keys() -> None:
    value = {"api_key": "abc", "nested": [{"password": "x", "name": "robot-1"}], "rekey_after_s": 120}
    assert scrubbed_value(value) == {
        "api_key": "(left out)",
        "nested": [{"password": "(left out)", "name": "robot-1"}],
        "rekey_after_s": 120,
    }
