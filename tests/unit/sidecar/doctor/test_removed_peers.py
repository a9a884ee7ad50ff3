from __future__ import annotations

from typing import Any

import pytest

from plr.protos.model.members import RemovalReason
from plr.sidecar.doctor import removed_peers, running_checks
from plr.sidecar.doctor.finding import Level
from tests.unit.sidecar.doctor.test_running_checks import BAD, path, state, texts


def removed(reason: str | None, kept: str | None = None, name: str = "cloud-c", **more: Any) -> dict[str, Any]:
    return {"name": name, "reason": reason, "since_s": 40.0, "kept": kept, **more}


def counts(**some: int) -> dict[str, int]:
    return {"path": 0, "dormant": 0, "forgotten": 0, **some}


@pytest.mark.parametrize(
    ("reason", "kept", "level", "words"),
    [
        ("lease_expired", "path", Level.WARN, "its lease expired; its paths work and stay in use"),
        ("lease_expired", "dormant", Level.WARN, "its lease expired; it is kept, no path to it is up now"),
        ("lease_expired", None, Level.WARN, "its lease expired"),
        ("left", None, Level.OK, "it was stopped"),
        ("revoked", None, Level.WARN, "its certificate was revoked"),
        ("forbidden", None, Level.WARN, "the access policy leaves the two nothing to do with each other"),
        ("expired", None, Level.WARN, "its certificate ended"),
        (None, "dormant", Level.WARN, "it does not list it any more; it is kept"),
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
    assert told == ["3 more were removed by the control plane"]
    many *= removed_peers.LISTED_AT_MOST // len(many) + 1
    told = texts(removed_peers.findings(state(removed_peers=many[: removed_peers.LISTED_AT_MOST])), Level.OK)
    assert told == ["at least 56 more were removed by the control plane"]
    assert not list(removed_peers.findings(state()))
    assert removed_peers.without(state())["gone"] == []


def test_a_dormant_peer_is_told_with_the_time_since_when_no_path_to_it_is_up() -> None:
    lost = removed("lease_expired", "dormant", dormant_s=20.0)
    (text,) = texts(removed_peers.findings(state(removed_peers=[{**lost, "since_s": 7200.0}])), Level.WARN)
    assert text == (
        "cloud-c: removed by the control plane 2 h ago: its lease expired; it is kept, no path to it has been up for "
        "20 s, and is a peer again as soon as a path answers"
    )


def test_a_dormant_peer_that_is_heard_one_way_only_is_told_as_that() -> None:
    lost = removed("lease_expired", "dormant", dormant_s=20.0, heard=True)
    (finding,) = removed_peers.findings(state(removed_peers=[lost]))
    assert finding.text.endswith("for 20 s: it is heard here, but does not hear the answers")
    assert "find what drops what this host sends to cloud-c" in finding.remedy


def test_a_kept_peer_whose_paths_are_all_down_has_no_paths_that_work() -> None:
    lost = removed("lease_expired", "path", name="cloud-a")
    for second, words in (
        ("up", "; its paths work and stay in use"),
        ("down", "; it is kept, but no path to it is up"),
    ):
        paths = [path("wlan0", "cloud-a", "down"), path("wwan0", "cloud-a", second), path("wlan0", "cloud-b")]
        (text,) = texts(removed_peers.findings(state(removed_peers=[lost], paths=paths)), Level.WARN)
        assert words in text


def test_the_rest_is_counted_by_what_became_of_it_and_no_time_is_claimed_for_who_is_kept() -> None:
    listed = [removed("lease_expired", "dormant", name=f"n{number}") for number in range(64)]
    told = state(removed_peers=listed, removed_counts=counts(path=2, dormant=1500))
    assert texts(removed_peers.findings(told), Level.OK) == [
        "2 more are kept that the control plane removed: their paths stay in use",
        "1492 more are kept that the control plane removed, without a path that is up: each is a peer again as soon as "
        "a path answers",
    ]
    listed = [removed("left", name=f"n{number}") for number in range(64)]
    for least in (False, True):
        told = state(removed_peers=listed, removed_counts={**counts(forgotten=70), "at_least": least})
        prefix = "at least " if least else ""
        last = texts(removed_peers.findings(told), Level.OK)[-1]
        assert last == f"{prefix}62 more were removed by the control plane within the last hour"
    told = state(removed_peers=listed[:8], removed_counts=counts(forgotten=8))
    assert len(list(removed_peers.findings(told))) == 8


def test_dormant_peers_are_named_and_those_that_are_not_listed_counted() -> None:
    assert removed_peers.dormant(state()) == ""
    assert removed_peers.dormant(state(removed_peers=[removed("left"), removed("lease_expired", "path")])) == ""
    listed = [removed("lease_expired", "dormant", name=f"n{number}", dormant_s=5.0) for number in range(4)]
    told = removed_peers.dormant(state(removed_peers=listed, removed_counts=counts(dormant=6)))
    assert told.startswith("n0 (removed 40 s ago: its lease expired, no path to it has been up for 5 s), n1 (")
    assert told.endswith("), 3 more")
    assert removed_peers.dormant(state(removed_counts=counts(dormant=6))) == "6 peers"
