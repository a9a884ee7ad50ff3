"""Pings of a link: what leaves, what comes back, and that nothing else changes by it."""

from __future__ import annotations

import pytest

from plr.protos.model.ids import InterfaceId
from plr.sidecar.core.base.values import PathId, PathState
from plr.sidecar.core.link.pinging import LEAST_BYTES, MAX_PINGS_OUT, PINGS_AT_ONCE, PINGS_PER_S, Pong
from plr.sidecar.core.seam.links import Ping, SetCarrier
from plr.sidecar.core.wire import frame
from plr.sidecar.core.wire.frame import BASE_BYTES, Probe, ProbeReply
from plr.sidecar.core.wire.introduction import Introduction
from tests.support.builders import WLAN, A, Bench

pytestmark = pytest.mark.audit("ops-14")

PATH = PathId(WLAN, A, InterfaceId(0))


def up() -> Bench:
    bench = Bench()
    (introduction,) = bench.frames(bench.sent())
    assert isinstance(introduction, Introduction)
    bench.now += 0.01
    bench.receive(frame.encode_probe_reply(ProbeReply(introduction.probe_id)))
    bench.sent()
    list(iter(bench.link.next_event, None))
    return bench


def pongs(bench: Bench) -> list[Pong]:
    found = list(bench.link.pongs)
    bench.link.pongs.clear()
    return found


def pinged(bench: Bench, number: int = 7, size: int = 64) -> Probe:
    """The PROBE of a ping that leaves now."""
    bench.execute(Ping(PATH, number, size))
    (datagram,) = bench.sent()
    assert len(datagram) == max(size, LEAST_BYTES)
    (probe,) = bench.frames([datagram])
    assert isinstance(probe, Probe)
    return probe


@pytest.mark.parametrize("size", [0, LEAST_BYTES, 64, BASE_BYTES])
def test_a_ping_is_a_probe_of_its_size_and_its_reply_a_pong(size: int) -> None:
    bench = up()
    probe = pinged(bench, 7, size)
    bench.now += 0.025
    bench.receive(frame.encode_probe_reply(ProbeReply(probe.id)))
    (pong,) = pongs(bench)
    assert (pong.number, pong.path, pong.problem) == (7, PATH, "")
    assert pong.rtt_s == pytest.approx(0.025)


def test_a_second_reply_is_no_second_pong() -> None:
    bench = up()
    probe = pinged(bench)
    for _ in range(2):
        bench.receive(frame.encode_probe_reply(ProbeReply(probe.id)))
    assert len(pongs(bench)) == 1
    assert bench.link.stats.dropped["unasked_probe_reply"] == 1


def test_it_changes_nothing_of_what_the_path_is_believed_to_be() -> None:
    calm, curious = up(), up()
    for bench in (calm, curious):
        bench.now += 0.1
    probe = pinged(curious)
    for bench in (calm, curious):
        bench.now += 0.2
    curious.receive(frame.encode_probe_reply(ProbeReply(probe.id)))
    assert pongs(curious)
    a, b = calm.link._paths[A, InterfaceId(0)], curious.link._paths[A, InterfaceId(0)]
    for of in (a, b):
        of.mtu.stop()
    measured = b.take_measured()
    assert measured is not None
    assert not measured.rtts_s
    assert (b.recovery.rtt.smoothed, b.recovery.rtt.latest) == (a.recovery.rtt.smoothed, a.recovery.rtt.latest)
    assert (b.silence_timer, b.state) == (a.silence_timer, a.state)
    assert (b.probing.at, b.probing.proven_at, b.probing.used_at) == (
        a.probing.at,
        a.probing.proven_at,
        a.probing.used_at,
    )


def test_unanswered_pings_do_not_bring_a_path_down() -> None:
    bench = up()
    path = bench.link._paths[A, InterfaceId(0)]
    timer = path.silence_timer
    pinged(bench)
    assert path.silence_timer == timer


def test_a_path_that_rests_is_pinged_and_goes_on_resting() -> None:
    bench = up()
    path = bench.link._paths[A, InterfaceId(0)]
    bench.now += 20.0
    due = path.probing.at = bench.now + 10.0
    probe = pinged(bench)
    bench.now += 0.01
    bench.receive(frame.encode_probe_reply(ProbeReply(probe.id)))
    assert [pong.problem for pong in pongs(bench)] == [""]
    assert path.probing.at == due


def test_what_cannot_be_pinged_is_told_and_sends_nothing() -> None:
    bench = Bench()
    bench.sent()
    bench.execute(Ping(PATH, 1, 64))
    assert [(pong.number, pong.problem) for pong in pongs(bench)] == [(1, "the path is down")]
    bench = up()
    bench.execute(Ping(PathId(WLAN, A, InterfaceId(9)), 2, 64))
    bench.execute(Ping(PATH, 3, BASE_BYTES + 1))
    assert [pong.problem for pong in pongs(bench)] == [
        "there is no such path",
        f"the path is known to carry {BASE_BYTES} bytes at most",
    ]
    assert bench.sent() == []
    bench.execute(SetCarrier(on=False))
    bench.execute(Ping(PATH, 4, 64))
    assert [pong.number for pong in pongs(bench)] == [4]
    assert bench.sent() == []


def test_nobody_sends_more_than_the_budget() -> None:
    bench = up()
    for number in range(1000):
        bench.execute(Ping(PATH, number, 64))
    assert len(bench.sent()) == PINGS_AT_ONCE
    refused = pongs(bench)
    assert len(refused) == 1000 - PINGS_AT_ONCE
    assert all("too many pings" in pong.problem for pong in refused)
    bench.now += 1.0
    for number in range(1000):
        bench.execute(Ping(PATH, number, 64))
    probes = [item for item in bench.frames(bench.sent()) if isinstance(item, Probe)]
    assert len(probes) in (PINGS_PER_S, PINGS_PER_S + 1)  # and perhaps the path's own


def test_unanswered_ones_are_forgotten() -> None:
    bench = up()
    for number in range(10 * MAX_PINGS_OUT):
        bench.now += 0.1
        bench.execute(Ping(PATH, number, 64))
        bench.sent()
        if bench.link._paths[A, InterfaceId(0)].state is PathState.DOWN:
            break
        assert len(bench.link._table.pings._out) <= MAX_PINGS_OUT


def test_a_reply_over_another_path_is_none() -> None:
    bench = up()
    probe = pinged(bench)
    other = bench.link._table.pings._out[probe.id]
    other.path = PathId(WLAN, A, InterfaceId(5))
    bench.receive(frame.encode_probe_reply(ProbeReply(probe.id)))
    assert pongs(bench) == []


def test_views_tell_how_the_path_is() -> None:
    bench = up()
    (view,) = bench.link.views(bench.now)
    assert (view.id, view.state, view.max_datagram) == (PATH, PathState.UP, BASE_BYTES)
    assert view.smoothed_rtt_s == pytest.approx(0.01)
    assert bench.link.paths_to(A) == [PATH]
    assert bench.link.paths_to("nobody") == []
