"""What a link does about the MTU of its paths, seen from outside."""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.sidecar.core.message.symbols import MessageSymbols
from plr.sidecar.core.path.pmtu import PROBE_TIMEOUT_S
from plr.sidecar.core.seam.links import FragmentsLost, PathMtuChanged, Send, SetMtu
from plr.sidecar.core.wire import frame
from plr.sidecar.core.wire.frame import BASE_BYTES, Probe, ProbeReply
from tests.support.builders import PEER_ADDRESS, Bench, message, path
from tests.unit.sidecar.core.link.test_link import up

if TYPE_CHECKING:
    from plr.protos.model.ids import Address

PATH = path()


def size_probes(bench: Bench, datagrams: list[bytes]) -> list[tuple[int, int]]:
    """(length, id) of each padded probe."""
    found = []
    for datagram in datagrams:
        frames = bench.opened(datagram)
        found += [(len(datagram), item.id) for item in frames if isinstance(item, Probe) and len(datagram) > BASE_BYTES]
    return found


def prove(bench: Bench, asked: list[bytes], source: Address) -> None:
    """Answer the probes among these datagrams from this address."""
    for item in bench.frames(asked):
        if isinstance(item, Probe):
            reply = bench.datagram(frame.encode_probe_reply(ProbeReply(item.id)))
            bench.receive_datagram(reply, source)


def search(bench: Bench, mtu: int = 1500) -> list[int]:
    """The interface takes `mtu`; answer every probe of the size. Returns the sizes told to the engine."""
    bench.execute(SetMtu(mtu))
    while probes := size_probes(bench, bench.sent()):
        for _, number in probes:
            bench.receive(frame.encode_probe_reply(ProbeReply(number)))
    return sizes(bench)


def sizes(bench: Bench) -> list[int]:
    return [event.max_datagram for event in bench.events() if isinstance(event, PathMtuChanged)]


def long_message() -> MessageSymbols:
    content = message(size=3000).content
    return MessageSymbols(2, content, deadline=10.0, expires=20.0, symbol=1472 - frame.FRAGMENT_OVERHEAD_BYTES)


def test_padded_probes_go_up_to_what_the_interface_takes() -> None:
    assert search(up()) == [1252, 1372, 1392, 1464, 1472]


def test_only_a_path_that_is_up_is_searched() -> None:
    bench = Bench()
    bench.execute(SetMtu(1500))
    assert size_probes(bench, bench.sent() + bench.wait(3.0)) == []


def test_a_lost_probe_of_the_size_is_no_loss() -> None:
    bench = up()
    bench.execute(SetMtu(1500))
    lost = size_probes(bench, bench.sent())
    assert len(lost) == 1
    bench.now += 1.5
    bench.link.handle_timer(bench.now)
    assert bench.link._paths[PATH.peer, PATH.remote].recovery.total_lost == 0


def test_what_is_too_long_is_handed_back_with_the_news() -> None:
    bench = up()
    outbound = long_message()
    bench.execute(Send(PATH, outbound))
    told, lost = bench.events()
    assert told == PathMtuChanged(PATH, BASE_BYTES)
    assert isinstance(lost, FragmentsLost)
    assert lost.indices == tuple(range(outbound.count))
    assert bench.sent() == []


def test_the_kernel_refuses_and_what_waits_is_handed_back() -> None:
    bench = up()
    search(bench)
    bench.execute(Send(PATH, long_message()))
    bench.link.on_too_big(("192.0.2.99", 1), 1472, bench.now)
    assert bench.events() == []
    bench.link.on_too_big(PEER_ADDRESS, 1472, bench.now)
    told, lost = bench.events()
    assert told == PathMtuChanged(PATH, 1464)
    assert isinstance(lost, FragmentsLost)
    assert lost.message.number == 2


def test_another_port_is_the_same_route_and_another_address_is_not() -> None:
    bench = up()
    search(bench)
    bench.now += PROBE_TIMEOUT_S
    bench.receive_datagram(bench.datagram(frame.encode_probe(Probe(1))), (PEER_ADDRESS[0], 9))
    assert sizes(bench) == []
    bench.receive_datagram(bench.datagram(frame.encode_probe(Probe(2))), ("192.0.2.77", 9))
    assert sizes(bench) == [BASE_BYTES]
    asked = bench.sent()
    assert size_probes(bench, asked) == [], "nothing long goes to where the peer has not proven to be"
    prove(bench, asked, ("192.0.2.77", 9))
    assert [length for length, _ in size_probes(bench, bench.sent())] == [1252]


def test_a_path_that_changes_again_and_again_is_not_filled_with_probes_of_the_size() -> None:
    bench = up()
    search(bench)
    bench.now += PROBE_TIMEOUT_S
    probes = []
    for number in range(100):
        frames = frame.encode_probe(Probe(number))
        bench.receive_datagram(bench.datagram(frames), (f"192.0.2.{number + 100}", 9))
        bench.link.handle_timer(bench.now)
        sent = bench.sent()
        prove(bench, sent, (f"192.0.2.{number + 100}", 9))
        probes += size_probes(bench, sent + bench.sent())
        bench.now += 0.01
    assert 1 <= len(probes) <= 2
