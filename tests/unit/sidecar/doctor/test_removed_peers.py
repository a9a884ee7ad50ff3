from __future__ import annotations

from typing import Any

import pytest

from plr.protos.model.members import RemovalReason
from plr.sidecar.doctor import removed_peers, running_checks
from plr.sidecar.doctor.finding import Level
from tests.unit.sidecar.doctor.test_running_checks import BAD, state, texts


def removed(reason: str | None, kept: str | None = None, name: str = "cloud-c") -> dict[str, Any]:
    return {"name": name, "reason": reason, "since_s": 40.0, "kept": kept}


@pytest.mark.parametrize(
    ("reason", "kept", "level", "words"),
    [
        ("lease_expired", "path", Level.WARN, "its lease expired; its paths work and stay in use"),
        ("lease_expired", "dormant", Level.WARN, "its lease expired; no path to it is up since"),
        ("lease_expired", None, Level.WARN, "its lease expired"),
        ("left", None, Level.OK, "it was stopped"),
        ("revoked", None, Level.WARN, "its certificate was revoked"),
        ("forbidden", None, Level.WARN, "the access policy leaves the two nothing to do with each other"),
        ("expired", None, Level.WARN, "its certificate ended"),
        (None, "dormant", Level.WARN, "it does not list it any more; no path"),
        ("a later version's", None, Level.WARN, "a later version's"),
    ],
)
def test_a_removed_peer_is_told_with_the_reason(reason: str | None, kept: str | None, level: Level, words: str) -> None:
    (text,) = texts(removed_peers.findings(state(removed_peers=[removed(reason, kept)])), level)
    assert text.startswith(f"cloud-c: removed by the control plane 40 s ago: {words}")


def test_each_reason_of_the_control_plane_has_words_of_its_own() -> None:
    told = [texts(removed_peers.findings(state(removed_peers=[removed(one.value)])), *Level) for one in RemovalReason]
    assert len({tuple(text) for text in told}) == len(RemovalReason)


def test_its_host_is_not_blamed_as_well() -> None:
    gone = [
        {"interface": "wlan0", "peer": peer, "since_s": 30.0, "reason": "silent"} for peer in ("cloud-c", "cloud-d")
    ]
    told = state(gone=gone, removed_peers=[removed("lease_expired", "dormant")])
    (text,) = texts(running_checks.gone(removed_peers.without(told)), *BAD)
    assert text.startswith("cloud-d: gone for 30 s")


def test_many_are_summed_up_and_an_older_sidecar_tells_of_none() -> None:
    many = [removed("lease_expired", name=f"n{number}") for number in range(removed_peers.MAX_SHOWN + 3)]
    told = texts(removed_peers.findings(state(removed_peers=many)), Level.OK)
    assert told == ["3 more were removed by the control plane within the last hour"]
    assert not list(removed_peers.findings(state()))
    assert removed_peers.without(state())["gone"] == []
