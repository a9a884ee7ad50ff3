"""Encodes the messages of the control streams: each peer once for all sidecars that receive it.

Protobuf allows the fields of a message in any order. A peer is therefore its encoding without the token, the same for
all, followed by the token, which differs for each sidecar.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.controlplane.core.publish.told_peers import ToldPeers
from plr.protos.convert.control import control_message_to_proto, peer_set_header_to_proto
from plr.protos.convert.types import peer_to_proto
from plr.protos.model.members import TOKEN_BYTES, PeerSet
from plr.protos.plr.v1 import control_pb2, types_pb2

if TYPE_CHECKING:
    from collections.abc import Iterator

    from plr.protos.model.members import Peer
    from plr.protos.model.stream import ControlMessage

PART_BYTES = 256 << 10
"""Bytes of a set's peers in one message: some 350 peers, a few milliseconds of the loop, far below gRPC's 4 MiB."""

MAX_KEPT_ENCODINGS = 16_384
"""Encodings kept: a fleet's peers, before and after each has changed. Beyond that all are discarded."""

MAX_KEPT_BYTES = 64 << 20
"""The same limit in bytes: the encodings of 4096 servers take some 4 MiB, one with the most offers half a MiB."""

_LENGTH_DELIMITED = 2


def _tag(field_number: int) -> bytes:
    return _varint(field_number << 3 | _LENGTH_DELIMITED)


def _varint(value: int) -> bytes:
    encoded = bytearray()
    while value > 0x7F:
        encoded.append(value & 0x7F | 0x80)
        value >>= 7
    encoded.append(value)
    return bytes(encoded)


_TOKEN = _tag(types_pb2.Peer.TOKEN_FIELD_NUMBER) + _varint(TOKEN_BYTES)
_PEER = _tag(control_pb2.PeerSet.PEERS_FIELD_NUMBER)
_PEER_SET = _tag(control_pb2.ControlMessage.PEERS_FIELD_NUMBER)


class StreamEncoder:
    """Encodes for all streams of one control plane."""

    def __init__(self) -> None:
        self._encoded: dict[int, tuple[Peer, bytes]] = {}
        """Encodings by the `id` of the peer, which is kept alive so that no other object gets that id."""
        self._kept_bytes = 0

    def encode(self, message: ControlMessage, *, incremental: bool) -> Iterator[bytes]:
        """Yield the encoded messages, each made on demand; only `incremental` sidecars take several."""
        if isinstance(message, PeerSet):
            yield from self._peer_set(message, PART_BYTES if incremental else None)
        else:
            yield control_message_to_proto(message).SerializeToString()

    def _peer_set(self, peer_set: PeerSet, part_bytes: int | None) -> Iterator[bytes]:
        header = peer_set_header_to_proto(peer_set)
        part: list[bytes] = []
        size = 0
        for peer in self._peers(peer_set):
            if part_bytes is not None and size >= part_bytes:
                header.more = True
                yield _message(header, part)
                header.ClearField("removed")
                part, size = [], 0
            part += (_PEER, _varint(len(peer)), peer)
            size += len(peer)
        header.more = False
        yield _message(header, part)

    def _peers(self, peer_set: PeerSet) -> Iterator[bytes]:
        peers = peer_set.peers
        if not isinstance(peers, ToldPeers):
            yield from (peer_to_proto(peer).SerializeToString() for peer in peers)
            return
        for peer, token in peers.with_tokens():
            known = self._encoded.get(id(peer))
            if known is None:
                known = peer, peer_to_proto(peer.with_token(b"")).SerializeToString()
                if len(self._encoded) >= MAX_KEPT_ENCODINGS or self._kept_bytes + len(known[1]) > MAX_KEPT_BYTES:
                    self._encoded.clear()
                    self._kept_bytes = 0
                self._encoded[id(peer)] = known
                self._kept_bytes += len(known[1])
            yield known[1] + _TOKEN + token


def _message(header: control_pb2.PeerSet, peers: list[bytes]) -> bytes:
    content = b"".join((header.SerializeToString(), *peers))
    return _PEER_SET + _varint(len(content)) + content
