"""The emulated links, with real packets: delay, loss, rate, outage, darkness, traces."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import pytest

from lab import DropReason, Lab, LabConfig, LabError, LinkProfile, parse_trace
from tests.netns.lab_traffic import PATIENCE_S, ping_times_ms, send_all, silent, udp, unreachable

if TYPE_CHECKING:
    from lab import LinkStats

pytestmark = pytest.mark.netns
PORT = 5000


def test_round_trip_is_at_least_the_delay_of_both_directions(lab: Lab) -> None:
    lab.link("wlan0").set(up=LinkProfile(delay_ms=15), down=LinkProfile(delay_ms=25))
    robot, cloud = lab.host("robot"), lab.host("cloud_a").address()
    delayed = ping_times_ms(robot, cloud, device="wlan0")
    plain = ping_times_ms(robot, cloud, device="wwan0")
    assert len(delayed) == len(plain) == 5
    assert min(delayed) >= 40
    assert min(plain) < min(delayed)


def test_loss_is_near_its_probability_and_decided_by_the_seed() -> None:
    def survivors(seed: int) -> list[bytes]:
        with Lab(LabConfig.of(interfaces=("wlan0",), clouds=1), seed=seed) as lab:
            lab.link("wlan0").set(up=LinkProfile(loss=0.2))
            cloud = lab.host("cloud_a")
            with udp(lab.host("robot")) as sender, udp(cloud, port=PORT) as receiver:
                payloads = [number.to_bytes(4, "big") for number in range(2000)]
                received = send_all(lab.link("wlan0"), sender, (cloud.address(), PORT), receiver, payloads)
            stats = lab.link("wlan0").stats()
            assert stats.up.kernel_drops == 0
            assert stats.up.drops[DropReason.LOSS] == 2000 - len(received)
            assert stats.down.drops[DropReason.LOSS] == 0
            return received

    first = survivors(seed=5)
    # Binomial: the standard deviation is 18, so six of them.
    assert abs(len(first) - 1600) < 108
    assert survivors(seed=5) == first
    assert survivors(seed=6) != first


def test_order_is_kept_under_jitter(lab: Lab) -> None:
    lab.link("wlan0").set(LinkProfile(delay_ms=1, jitter_ms=30))
    cloud = lab.host("cloud_a")
    with udp(lab.host("robot"), device="wlan0") as sender, udp(cloud, port=PORT) as receiver:
        payloads = [number.to_bytes(4, "big") for number in range(500)]
        assert send_all(lab.link("wlan0"), sender, (cloud.address(), PORT), receiver, payloads) == payloads


def test_rate_is_kept_to(lab: Lab) -> None:
    rate_kbps, packets, packet_bytes = 6000, 400, 1200
    lab.link("wlan0").set(up=LinkProfile(rate_kbps=rate_kbps))
    cloud = lab.host("cloud_a")
    with udp(lab.host("robot"), device="wlan0") as sender, udp(cloud, port=PORT) as receiver:
        began = time.monotonic()
        for _ in range(packets):
            sender.sendto(bytes(packet_bytes - 28), (cloud.address(), PORT))  # IPv4 and UDP headers: 28
        for _ in range(packets):
            receiver.recv(2000)
        took = time.monotonic() - began
    ideal = packets * packet_bytes * 8 / (rate_kbps * 1000)
    # Never faster. Slower only by a busy machine's delays: of the order of ms, not of the rate.
    assert ideal <= took < 1.5 * ideal


def test_outage_keeps_a_queueful_and_delivers_it_afterwards(lab: Lab) -> None:
    link, cloud = lab.link("wlan0"), lab.host("cloud_a")
    link.set(LinkProfile(queue_bytes=60_000))
    link.outage()
    before = link.stats()
    with udp(lab.host("robot"), device="wlan0") as sender, udp(cloud, port=PORT) as receiver:
        for number in range(80):
            sender.sendto(bytes([number]) * 1172, (cloud.address(), PORT))
        assert silent(receiver)
        stats = link.stats()
        assert stats.up.queue_bytes == 60_000
        assert dropped(stats, before, DropReason.QUEUE_FULL) == 30
        link.change(rate_kbps=None)
        assert [receiver.recv(2000)[0] for _ in range(50)] == list(range(50))
        assert silent(receiver)


def test_blackhole_loses_everything_while_the_carrier_stays(lab: Lab) -> None:
    link, robot, cloud = lab.link("wlan0"), lab.host("robot"), lab.host("cloud_a")
    with udp(robot, device="wlan0") as sender, udp(cloud, port=PORT) as receiver:
        sender.sendto(b"before", (cloud.address(), PORT))
        assert receiver.recv(100) == b"before"
        link.blackhole()
        before = link.stats()
        for _ in range(20):
            sender.sendto(b"lost", (cloud.address(), PORT))
        assert silent(receiver)
        assert carrier(lab, "wlan0") == "1"
        stats = link.stats()
        assert stats.dark is DropReason.BLACKHOLE
        assert dropped(stats, before, DropReason.BLACKHOLE) == 20
        # The other interface does not notice.
        assert len(ping_times_ms(robot, cloud.address(), device="wwan0", count=2)) == 2
        link.restore()
        sender.sendto(b"after", (cloud.address(), PORT))
        assert receiver.recv(100) == b"after"


def test_unplugged_interface_loses_its_carrier_and_gets_it_back(lab: Lab) -> None:
    link, robot, cloud = lab.link("wlan0"), lab.host("robot"), lab.host("cloud_a")
    link.unplug()
    assert carrier(lab, "wlan0") == "0"
    assert carrier(lab, "wwan0") == "1"
    link.restore()
    assert carrier(lab, "wlan0") == "1"
    assert len(ping_times_ms(robot, cloud.address(), device="wlan0", count=2)) == 2


def test_interface_taken_down_comes_back_with_its_routes(lab: Lab) -> None:
    robot, cloud = lab.host("robot"), lab.host("cloud_a")
    routes = robot.run(["ip", "route"]).stdout
    robot.link_down("wlan0")
    assert "wlan0" not in robot.run(["ip", "route"]).stdout
    assert unreachable(robot, cloud.address(), device="wlan0")
    robot.link_up("wlan0")
    assert sorted(robot.run(["ip", "route"]).stdout.splitlines()) == sorted(routes.splitlines())
    for family in (4, 6):
        address = cloud.address(family=family)
        assert len(ping_times_ms(robot, address, device="wlan0", family=family, count=2)) == 2


def test_trace_is_followed_on_both_links_on_one_clock(lab: Lab) -> None:
    header = "t_s,a_up_kbps,a_down_kbps,a_rtt_ms,a_loss,b_up_kbps,b_down_kbps,b_rtt_ms,b_loss\n"
    trace = parse_trace(
        header
        + "0.0,9000,9000,10,0,9000,9000,20,0\n"
        + "0.3,0,9000,10,0,9000,9000,20,0\n"
        + "0.6,9000,9000,60,0,9000,9000,80,1\n"
    )
    links = {"a": lab.link("wlan0"), "b": lab.link("wwan0")}
    for link in links.values():
        link.stats(reset=True)
    start = lab.replay(trace, {"wlan0": "a", "wwan0": "b"}, start=time.monotonic() + 0.1)
    seen: dict[str, list[LinkProfile]] = {path: [] for path in links}
    while time.monotonic() < start + PATIENCE_S and any(
        profiles[-1:] != [trace.path(path)[-1].up] for path, profiles in seen.items()
    ):
        for path, link in links.items():
            profile = link.stats().up.profile
            if profile not in seen[path]:
                seen[path].append(profile)
        time.sleep(0.01)
    assert time.monotonic() >= start + 0.6
    for path, link in links.items():
        expected = [step.up for step in trace.path(path)]
        assert [profile for profile in seen[path] if profile in expected] == list(dict.fromkeys(expected))
        assert link.stats().step_lateness.count == 3
    robot, cloud = lab.host("robot"), lab.host("cloud_a").address()
    assert min(ping_times_ms(robot, cloud, device="wlan0", count=2)) >= 60
    lab.link("wwan0").set(down=LinkProfile())  # ends the replay, keeps the other direction
    assert unreachable(robot, cloud, device="wwan0")


def test_emulator_reports_how_late_it_was(lab: Lab) -> None:
    link = lab.link("wlan0")
    link.set(LinkProfile(delay_ms=5))
    link.stats(reset=True)
    ping_times_ms(lab.host("robot"), lab.host("cloud_a").address(), device="wlan0")
    stats = link.stats()
    assert stats.lateness.count >= 10
    assert 0 < stats.lateness.p50_s <= stats.lateness.p99_s <= stats.lateness.max_s
    assert stats.longest_turn_s > 0
    assert stats.cpu_s > 0
    assert link.stats(reset=True).lateness.count >= stats.lateness.count
    assert link.stats().lateness.count < stats.lateness.count


def test_senseless_profile_leaves_the_link_running(lab: Lab) -> None:
    link = lab.link("wlan0")
    with pytest.raises(LabError, match="loss"):
        link._ask("set", up={"loss": 7}, down=None)
    with pytest.raises(LabError, match="no such request"):
        link._ask("explode")
    assert link.stats().up.profile == LinkProfile()


def carrier(lab: Lab, interface: str) -> str:
    return lab.host("robot").run(["cat", f"/sys/class/net/{interface}/carrier"]).stdout.strip()


def dropped(after: LinkStats, before: LinkStats, reason: DropReason) -> int:
    return after.up.drops[reason] - before.up.drops[reason]
