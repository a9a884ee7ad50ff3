"""One bad interface, driver or peer delays nothing on another: real threads and sockets over loopback.

No limit here is a time of its own: what is measured is compared with the trouble's length, or with the same calls when
nothing troubles them.
"""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
import threading
import time
from typing import TYPE_CHECKING

from tests.integration.isolated_interfaces import PATIENCE_S, Call, Robot, latencies

if TYPE_CHECKING:
    from pathlib import Path

HANG_S = 4.0
"""Each send of the bad driver takes so long."""
CALM_S = 1.5


def worst(calls: list[Call]) -> float:
    return latencies(calls)[-1]


def test_a_driver_that_hangs_delays_nothing_on_another_interface(tmp_path: Path) -> None:
    mapping = {"/good": ("wlan0", "cloud"), "/bad": ("wwan0", "cloud")}
    with Robot(tmp_path, ("wlan0", "wwan0"), mapping) as robot:
        robot.beat("/good", CALM_S)
        robot.beat("/bad", CALM_S)
        robot.sockets["wwan0"].hang_s = HANG_S
        bad: list[Call] = []
        beating = threading.Thread(target=lambda: bad.extend(robot.beat("/bad", HANG_S / 2, rate_hz=10.0)))
        beating.start()
        good = robot.beat("/good", HANG_S / 2)
        beating.join(PATIENCE_S)
        assert worst(good) < HANG_S / 4
        # Those that were mapped to the bad interface alone took the other one, once it was found to hang.
        assert len(bad) == int(HANG_S / 2 * 10)
        assert worst(bad) < HANG_S / 2
        assert {call.interface for call in bad[len(bad) // 2 :]} == {"wlan0"}
        assert robot.threads["wwan0"].link.stats.hangs == 1
        robot.sockets["wwan0"].hang_s = 0.0
        assert until_over(robot, "wwan0")
        assert robot.calls["/bad"][-1] is not bad[-1]


def test_a_full_socket_buffer_holds_one_burst_and_nothing_stale_leaves_it(tmp_path: Path) -> None:
    mapping = {"/good": ("wlan0", "cloud"), "/bad": ("wwan0", "cloud")}
    with Robot(tmp_path, ("wlan0", "wwan0"), mapping) as robot:
        calm = robot.beat("/good", CALM_S)
        robot.beat("/bad", 0.5)
        sock, thread = robot.sockets["wwan0"], robot.threads["wwan0"]
        sock.full = True
        backlog = [robot.submit("/bad", 500_000) for _ in range(6)]
        waiting = 0
        good: list[Call] = []
        beating = threading.Thread(target=lambda: good.extend(robot.beat("/good", CALM_S)))
        beating.start()
        while beating.is_alive():
            waiting = max(waiting, sum(len(batch.data) for batch in list(thread._unsent)))
            time.sleep(0.005)
        assert latencies(good)[len(good) // 2] < 20 * latencies(calm)[len(calm) // 2]
        robot.wait_for_answers(backlog)
        assert 0 < waiting < 4 * 65_000
        dropped = thread.link.stats.dropped
        assert dropped["send_buffer_full_waits"] > 0
        assert dropped["unsent_of_path_down"] > 0
        sock.sent.clear()
        sock.full = False
        assert until_over(robot, "wwan0")
        # Probes to find that it is back, then the new requests: nothing of the backlog.
        assert sum(sock.sent) < 100_000


def until_over(robot: Robot, interface: str) -> bool:
    """Call until the answers come over this interface again."""
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        if robot.beat("/bad", 0.2)[-1].interface == interface:
            return True
    return False


def test_a_peer_that_takes_nothing_delays_no_other_peer_on_the_same_interface(tmp_path: Path) -> None:
    mapping = {"/good": ("wlan0", "cloud_a"), "/stalled": ("wlan0", "cloud_b")}
    with Robot(tmp_path, ("wlan0",), mapping) as robot:
        calm = robot.beat("/good", CALM_S)
        process = robot.clouds["cloud_b"]._process
        os.kill(process.pid, signal.SIGSTOP)
        try:
            backlog = [robot.submit("/stalled", 2_000_000) for _ in range(8)]
            beside = robot.beat("/good", CALM_S * 2)
        finally:
            os.kill(process.pid, signal.SIGCONT)
        assert all(call.latency_s is None for call in backlog)
        assert latencies(beside)[len(beside) // 2] < 20 * latencies(calm)[len(calm) // 2]
        assert worst(beside) < CALM_S
        robot.wait_for_answers(backlog)


FLOOD = """
import socket, sys
out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
out.connect(("127.0.0.2", int(sys.argv[1])))
while True:
    out.send(bytes((0xD3, 1)) + bytes(50))
"""


def test_a_flood_on_one_interface_starves_neither_its_own_timers_nor_the_other(tmp_path: Path) -> None:
    mapping = {"/good": ("wlan0", "cloud_a"), "/flooded": ("wwan0", "cloud_a")}
    with Robot(tmp_path, ("wlan0", "wwan0"), mapping) as robot:
        calm = robot.beat("/good", CALM_S)
        thread = robot.threads["wwan0"]
        looked: list[float] = []
        handle_timer = thread.link.handle_timer

        def noting(now: float) -> None:
            looked.append(now)
            handle_timer(now)

        thread.link.handle_timer = noting  # type: ignore[method-assign]  # a spy on the running thread
        with subprocess.Popen([sys.executable, "-c", FLOOD, str(thread.port)]) as flood:
            try:
                beside = robot.beat("/good", CALM_S * 2)
            finally:
                flood.kill()
        assert thread.link.stats.dropped["unknown_session"] + thread.link.stats.dropped["malformed"] > 1000
        assert latencies(beside)[len(beside) // 2] < 20 * latencies(calm)[len(calm) // 2]
        assert max(after - before for before, after in itertools.pairwise(looked)) < CALM_S / 2


def test_an_interface_that_computes_flat_out_leaves_the_interpreter_to_the_other(tmp_path: Path) -> None:
    mapping = {"/good": ("wlan0", "cloud_a"), "/bulk": ("wwan0", "cloud_b")}
    with Robot(tmp_path, ("wlan0", "wwan0"), mapping) as robot:
        calm = robot.beat("/good", CALM_S)
        stop = threading.Event()

        def flood() -> None:
            while not stop.is_set():
                robot.wait_for_answers([robot.submit("/bulk", 1_000_000) for _ in range(4)])

        flooding = threading.Thread(target=flood)
        flooding.start()
        try:
            beside = robot.beat("/good", CALM_S * 2)
        finally:
            stop.set()
            flooding.join(PATIENCE_S)
        assert robot.threads["wwan0"].link.stats.bytes["sent"] > 2_000_000
        # Two processors for three busy processes: the tail of each is the scheduler's. The typical call is ours.
        assert latencies(beside)[len(beside) // 2] < 20 * latencies(calm)[len(calm) // 2]
        assert worst(beside) < CALM_S
