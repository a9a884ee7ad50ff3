"""Whatever a process of the ROS domain says of its nodes: RosBridgeError and nothing else refuses it, and nothing more
than ids and names that were asked for is kept of it."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from plr.sidecar.ros.errors import RosBridgeError
from plr.sidecar.ros.graph.participant_info import nodes_of
from plr.sidecar.ros.graph.unknown_nodes import UnknownNodes
from tests.support.participant_messages import endpoint, participant_info

WRITERS = [endpoint(7, number) for number in range(6)]
INFO = participant_info(7, [("/", "planner", WRITERS[:1], WRITERS[1:3]), ("/arm", "other", [], WRITERS[3:])])


def read(info: bytes) -> None:
    read_bytes, refusal = 0, ""
    try:
        for name, writers in nodes_of(info):
            assert name.startswith("/")
            assert name.isascii()
            assert name.isprintable()
            assert all(len(writer) == 16 for writer in writers)
            read_bytes += len(name) + 16 * len(writers)
    except RosBridgeError as error:
        refusal = str(error)
    assert not refusal or refusal.isprintable()
    assert read_bytes <= len(info)
    unknown = UnknownNodes()
    for writer in WRITERS:
        unknown.name_of(writer, 0.0)
    try:
        learned = unknown.learn(info)
    except RosBridgeError:
        return
    assert len(learned) <= len(WRITERS)


@given(st.binary(max_size=2000))
def test_any_bytes(data: bytes) -> None:
    read(data)
    read(INFO[:20] + data)


@given(st.lists(st.tuples(st.integers(0, len(INFO) - 1), st.integers(0, 255)), min_size=1, max_size=4))
def test_a_message_changed_anywhere(changes: list[tuple[int, int]]) -> None:
    info = bytearray(INFO)
    for place, value in changes:
        info[place] = value
    read(bytes(info))
