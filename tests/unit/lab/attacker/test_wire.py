"""JSON lines between the lab's processes."""

from __future__ import annotations

import os
import socket

import pytest

from lab.errors import LabError
from lab.wire import LineSocket


def test_messages_arrive_whole_however_they_were_cut() -> None:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        line = LineSocket(ours)
        theirs.send(b'{"a": 1}\n{"b"')
        assert line.receive_ready() == [{"a": 1}]
        theirs.send(b": 2}\n")
        assert line.receive() == {"b": 2}
        LineSocket(theirs).send({"c": [3]})
        assert line.receive() == {"c": [3]}


def test_end_of_the_other_side_is_told() -> None:
    ours, theirs = socket.socketpair()
    with ours:
        theirs.close()
        assert LineSocket(ours).receive() is None
        assert LineSocket(ours).receive_ready() is None


@pytest.mark.parametrize("garbage", [b"{\n", b"[]\n", b"\xff\n"])
def test_garbage_is_a_lab_error(garbage: bytes) -> None:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        theirs.send(garbage)
        with pytest.raises(LabError, match="garbage"):
            LineSocket(ours).receive()


def test_open_file_comes_along_with_its_message() -> None:
    ours, theirs = socket.socketpair()
    reader, writer = os.pipe()
    with ours, theirs:
        LineSocket(theirs).send_with_descriptors({"ok": True}, [writer])
        os.close(writer)
        line = LineSocket(ours)
        assert line.receive() == {"ok": True}
        received = line.take_descriptor()
        with pytest.raises(LabError, match="no open file"):
            line.take_descriptor()
        os.write(received, b"through")
        os.close(received)
        assert os.read(reader, 10) == b"through"
        os.close(reader)
