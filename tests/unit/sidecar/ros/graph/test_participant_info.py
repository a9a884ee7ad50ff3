"""What a ROS process says of its nodes is read, or refused with one error."""

from __future__ import annotations

import pytest

from plr.sidecar.ros.errors import RosBridgeError
from plr.sidecar.ros.graph.participant_info import MAX_INFO_BYTES, MAX_NODES, nodes_of, speaker
from tests.support.participant_messages import Node, endpoint, participant_info

READERS = [endpoint(7, 1), endpoint(7, 2)]
WRITERS = [endpoint(7, 3), endpoint(7, 4), endpoint(7, 5)]


@pytest.mark.parametrize("order", ["<", ">"])
def test_nodes_and_their_writers(order: str) -> None:
    nodes: list[Node] = [
        ("/", "planner", READERS, WRITERS[:2]),
        ("/arm/left", "_hidden", [], WRITERS[2:]),
        ("/", "silent", READERS, []),
    ]
    info = participant_info(7, nodes, order)
    assert speaker(info) == endpoint(7, 0)[:12]
    assert list(nodes_of(info)) == [
        ("/planner", frozenset(WRITERS[:2])),
        ("/arm/left/_hidden", frozenset(WRITERS[2:])),
        ("/silent", frozenset()),
    ]


def test_a_process_without_nodes() -> None:
    assert list(nodes_of(participant_info(7, []))) == []


@pytest.mark.parametrize(
    ("namespace", "name"),
    [
        ("/", ""),
        ("", "planner"),
        ("arm", "planner"),
        ("/arm/", "planner"),
        ("//", "planner"),
        ("/", "plan\nner"),
        ("/", "planner\n"),
        ("/\n", "planner"),
        ("/", "a/b"),
        ("/", "plän"),
        ("/", "p\0q"),
        ("/", "p" * 256),
    ],
)
def test_what_is_no_name_is_refused(namespace: str, name: str) -> None:
    with pytest.raises(RosBridgeError) as refused:
        list(nodes_of(participant_info(7, [(namespace, name, [], WRITERS)])))
    assert str(refused.value).isprintable()


def test_every_message_that_is_cut_off_is_refused() -> None:
    info = participant_info(7, [("/", "planner", READERS, WRITERS), ("/arm", "other", [], [])])
    for end in range(len(info)):
        with pytest.raises(RosBridgeError):
            list(nodes_of(info[:end]))


def test_lengths_that_the_bytes_do_not_bear_out_take_no_time() -> None:
    info = bytearray(participant_info(7, []))
    info[-4:] = b"\xff\xff\xff\xff"
    with pytest.raises(RosBridgeError, match="4294967295 nodes"):
        list(nodes_of(bytes(info)))
    info[-4:] = MAX_NODES.to_bytes(4, "little")
    with pytest.raises(RosBridgeError, match="is truncated"):
        list(nodes_of(bytes(info)))
    endless = bytearray(participant_info(7, [("/", "planner", [], [])]))
    endless[-4:] = b"\xff\xff\xff\xff"
    with pytest.raises(RosBridgeError, match="is truncated"):
        list(nodes_of(bytes(endless)))
    with pytest.raises(RosBridgeError, match="are allowed"):
        list(nodes_of(bytes(info) + bytes(MAX_INFO_BYTES)))


def test_an_unknown_representation_is_refused() -> None:
    with pytest.raises(RosBridgeError, match="0003"):
        list(nodes_of(b"\0\3" + participant_info(7, [])[2:]))
