"""A link that is fed garbage and mangled datagrams never raises, stays bounded and goes on serving."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from plr.protos.model.ids import InterfaceId, SessionId
from plr.sidecar.core.base.values import PathId
from plr.sidecar.core.crypto.aead import TAG_BYTES
from plr.sidecar.core.link.path_table import MAX_PATHS_OF_A_PEER
from plr.sidecar.core.path.owed import MAX_PENDING_FRAMES
from plr.sidecar.core.seam.links import FragmentsReceived, Send
from plr.sidecar.core.wire import frame
from plr.sidecar.core.wire.frame import MAX_ACK_RANGES, Header, Probe, ProbeReply
from tests.support.builders import OUR_TOKEN, PEER_ADDRESS, PEER_SESSION, PEER_TOKEN, WLAN, A, Bench, message

numbers = st.integers(0, 60) | st.integers(0, 2**64 - 1)
acks = st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5)), min_size=1, max_size=40)


def encode_ack(largest: int, shape: list[tuple[int, int]]) -> bytes:
    body = b"".join(length.to_bytes(2, "big") + gap.to_bytes(2, "big") for length, gap in shape)
    return b"\x03" + largest.to_bytes(8, "big") + bytes(4) + bytes([len(shape)]) + body


fragments = st.builds(
    lambda number, total, symbol, index, size: frame.encode_fragment_head(number, total, symbol, index) + bytes(size),
    numbers,
    st.integers(0, 2**32 - 1) | st.just(3000),
    st.integers(0, 2**16 - 1) | st.just(300),
    st.integers(0, 12),
    st.integers(0, 1000) | st.just(300),
)
frames = st.one_of(
    st.integers(0, 70).map(lambda n: frame.encode_probe(Probe(n))),
    st.integers(0, 70).map(lambda n: frame.encode_probe_reply(ProbeReply(n))),
    st.builds(encode_ack, numbers, acks),
    fragments,
    numbers.map(lambda n: frame.encode_finished(frame.Finished(n))),
    st.just(frame.encode_close()),
    st.binary(max_size=20),
)
PEER = Bench()
"""Seals for all benches: they have the same keys."""
sessions = st.sampled_from([PEER_SESSION, PEER_SESSION, PEER_SESSION, SessionId(5)])
sealed = st.builds(
    lambda interface, receiver, session, number, body: PEER.datagram(
        *body, number=number, session=session, interface=InterfaceId(interface), receiver=InterfaceId(receiver)
    ),
    st.sampled_from([0, 0, 0, 1]),
    st.sampled_from([3, 3, 3, 4]),
    sessions,
    numbers,
    st.lists(frames, min_size=1, max_size=5),
)
introductions = st.builds(
    lambda token, number, session, interface, incarnation: PEER.introduction(
        token=token, number=number, session=session, interface=InterfaceId(interface), incarnation=incarnation
    ),
    st.sampled_from([PEER_TOKEN, PEER_TOKEN, OUR_TOKEN]),
    numbers,
    sessions,
    st.integers(0, 255),
    st.integers(0, 3),
)
headers = st.builds(Header, st.just(InterfaceId(0)), st.just(InterfaceId(3)), sessions, numbers, st.integers(0, 255))
in_clear = st.builds(lambda header, body: frame.encode_header(header) + b"".join(body), headers, st.lists(frames))
datagrams = st.one_of(st.binary(max_size=60), in_clear, sealed, sealed, introductions)
ops = st.tuples(datagrams, st.sampled_from([0.0, 0.0, 0.001, 0.05, 1.0]), st.booleans())
mutations = st.lists(st.tuples(st.integers(0, 1200), st.integers(0, 255)), max_size=3)


def assert_bounded(bench: Bench) -> None:
    link = bench.link
    assert 1 <= len(link._paths) <= MAX_PATHS_OF_A_PEER  # its token introduces further ones
    for path in link._paths.values():
        assert len(path.owed._frames) <= MAX_PENDING_FRAMES
        assert len(path.received._ranges) <= MAX_ACK_RANGES
        assert 0 <= path.recovery.in_flight == sum(sent.size for sent in path.recovery.sent)
        assert path.control.window > 0
    assert len(link.stats.dropped) < 20


@given(st.lists(ops, max_size=30))
def test_whatever_comes_the_link_stands_and_answers_honest_probes(
    steps: list[tuple[bytes, float, bool]],
) -> None:
    bench = Bench()
    path = PathId(WLAN, A, InterfaceId(0))
    for number, (data, pause, send) in enumerate(steps):
        if send:
            bench.execute(Send(path, message(number, expires=1e9)))
        bench.receive_datagram(data)
        bench.events()
        bench.sent()
        bench.wait(pause)
        assert_bounded(bench)
    bench.wait(120.0)  # a round trip of seconds makes silence mean little for a while
    bench.events()
    assert bench.link.next_timer() > bench.now
    assert all(not path.recovery.sent for path in bench.link._paths.values()), "everything is acknowledged or lost"
    bench.know(session=SessionId(77), incarnation=2)
    probe = frame.encode_probe(Probe(4242))
    bench.receive_datagram(bench.datagram(probe, session=SessionId(77)))
    assert ProbeReply(4242) in bench.frames(bench.sent())


@given(st.lists(st.tuples(mutations, st.booleans()), min_size=1, max_size=20), st.integers(0, 5000))
def test_real_datagrams_mangled_on_the_way(plan: list[tuple[list[tuple[int, int]], bool]], size: int) -> None:
    """The frames of a link come back to it as if its peer had sent them, some bytes of them changed."""
    bench = Bench()
    path = PathId(WLAN, A, InterfaceId(0))
    for number, (changes, send) in enumerate(plan):
        if send:
            bench.execute(Send(path, message(number, size, expires=1e9)))
        for sent in bench.sent() + bench.wait(0.02):
            if frame.decode_header(sent).flags & frame.INTRODUCTION_FLAG:
                continue
            plain = bytearray(bench.plain(sent))
            for position, value in changes:
                plain[position % len(plain)] = value
            bench.receive_datagram(bench.datagram(bytes(plain)))
        bench.events()
        assert_bounded(bench)


@pytest.mark.parametrize("seed", range(60))
def test_a_batch_does_what_its_datagrams_do_one_by_one(seed: int) -> None:
    """Fragments in and out of order, doubled, mangled, of strangers, with other frames between them."""
    rng = random.Random(seed)
    symbol = frame.MIN_SYMBOL_BYTES
    segment = frame.FRAGMENT_OVERHEAD_BYTES + symbol
    together, apart = Bench(), Bench()
    apart.fresh_peer_keys()
    number = 0
    for _ in range(20):
        run: list[bytes] = []
        for _ in range(rng.randint(1, 40)):
            number += rng.choice([1, 1, 1, 1, 1, 2, 0, -3])
            index = rng.randrange(21)  # repair symbols from 10 on; a message of ten has no 20th
            body = frame.encode_fragment_head(rng.randrange(3), 10 * symbol, symbol, index) + bytes(symbol)
            if rng.random() < 0.1:
                body = rng.choice([frame.encode_probe(Probe(1)), frame.encode_finished(frame.Finished(5))])
                body += frame.encode_padding(segment - frame.HEADER_BYTES - TAG_BYTES - len(body))
            session = SessionId(77) if rng.random() < 0.03 else PEER_SESSION
            plain = bytearray(body)
            if rng.random() < 0.1:
                plain[rng.randrange(frame.FRAGMENT_HEAD_BYTES)] = rng.randrange(256)
            datagram = bytearray(together.datagram(bytes(plain), number=max(number, 0), session=session))
            if rng.random() < 0.05:
                datagram[rng.randrange(len(datagram))] ^= rng.randrange(1, 256)
            run.append(bytes(datagram))
        if rng.random() < 0.3:
            run[-1] = run[-1][: rng.randrange(segment)]
        data = b"".join(run)
        together.link.receive_batch(memoryview(data), segment, PEER_ADDRESS, together.now)
        for one in filter(None, run):
            apart.receive_datagram(one)
        assert symbols(together) == symbols(apart)
        for bench in (together, apart):
            assert_bounded(bench)
        assert together.link.stats.dropped == apart.link.stats.dropped
        assert together.link.stats.datagrams == apart.link.stats.datagrams
        assert together.sent() == apart.sent()


def symbols(bench: Bench) -> list[object]:
    """What was handed up, however it was grouped."""
    out: list[object] = []
    for event in bench.events():
        out += [tuple(item) for item in event.fragments] if isinstance(event, FragmentsReceived) else [event]
    return out


def test_a_head_that_reaches_into_the_next_datagram_is_malformed() -> None:
    bench = Bench()
    bench.link.next_event()
    # One symbol too far, by as many bytes as the datagram is too short.
    head = bytes([frame.FRAGMENT_TYPE]) + frame.encode_fragment_head(1, 249, 256, 1)[1:]
    bench.receive(head)
    bench.receive(head[:-7])
    assert bench.events() == []
    assert bench.link.stats.dropped == {"malformed": 2}
