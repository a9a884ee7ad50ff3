"""Servers that are killed: noticed at once where their process is known, soon where not, and never without cause."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from typing import TYPE_CHECKING

import pytest

from plr.protos.model.ids import ServiceName
from plr.sidecar.core.base.values import RejectReason
from plr.sidecar.ros.cloud import dds_id, process_finder, server_processes
from plr.sidecar.ros.cloud.cloud_side import SILENCE_S
from plr.sidecar.ros.cloud.process_finder import has_ended, open_process, wants_processor
from plr.sidecar.ros.cloud.roll_call import CALL_S
from plr.sidecar.ros.graph import graph
from tests.ros.mesh import no_name, wait_until

if TYPE_CHECKING:
    from plr.sidecar.ros.ros_loop import RosLoop
    from tests.ros.mesh import Mesh

pytestmark = pytest.mark.ros

PLAN = ServiceName("/plan")
LEASE_S = 20.0
"""After which DDS itself notices."""


def loop_of(mesh: Mesh) -> RosLoop:
    loop = mesh.cloud._loop
    assert loop is not None
    return loop


def endpoints(mesh: Mesh) -> set[bytes]:
    return set().union(*graph.server_endpoints(loop_of(mesh).node, PLAN, no_name, 0.0).values())


def blind(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if every server ran in a container: no process id means anything."""
    monkeypatch.setattr("plr.sidecar.ros.cloud.server_processes.open_process", lambda _endpoint, _domain: None)


@pytest.mark.audit("dp-15")
def test_what_waits_for_a_killed_server_is_free_at_once(mesh: Mesh) -> None:
    mesh.start()
    server = mesh.serve("--plan", "/plan")
    mesh.wait_carried("/plan")
    mesh.call("/plan", "--count", "60", "--tolerance", "-1", "--timeout-s", "1")
    wait_until(lambda: mesh.cloud.stats.pending == 60, "60 requests in the cloud")
    killed_at = time.monotonic()
    server.stop(signal.SIGKILL)
    wait_until(lambda: len(mesh.link.refusals) == 60, "60 refusals")
    reasons = [reason for reason, _ in mesh.link.refusals]
    # What lay in the server's queue may have run; everything else another cloud can run.
    assert 1 <= reasons.count(RejectReason.SERVER_LOST) <= 10
    assert reasons.count(RejectReason.NOT_OFFERED) == 60 - reasons.count(RejectReason.SERVER_LOST)
    mesh.wait_carried()
    assert time.monotonic() - killed_at < LEASE_S / 2
    assert endpoints(mesh), "DDS noticed by itself: this shows nothing"
    assert not mesh.cloud.stats.pending


@pytest.mark.audit("dp-15")
def test_a_server_that_is_started_again_is_used_beside_its_dead_self(mesh: Mesh) -> None:
    mesh.start()
    dead: set[bytes] = set()
    for _ in range(3):
        server = mesh.serve("--plan", "/plan")
        mesh.wait_carried("/plan")
        assert not dead or endpoints(mesh) & dead, "the lease of the dead one is over: this shows nothing"
        dead = endpoints(mesh)
        result = mesh.result(mesh.call("/plan", "--count", "20", "--timeout-s", "10"))
        assert (result["answered"], result["twice"], result["wrong"]) == (20, 0, 0)
        server.stop(signal.SIGKILL)
        mesh.wait_carried()


@pytest.mark.audit("dp-15")
def test_the_process_behind_an_endpoint(mesh: Mesh) -> None:
    """No process is taken for a server but one that takes part in the domain under the endpoint's process id."""
    mesh.start()
    server = mesh.serve("--plan", "/plan")
    mesh.wait_carried("/plan")
    domain = mesh.cloud_domain
    (endpoint,) = endpoints(mesh)
    pidfd = open_process(endpoint, domain)
    assert pidfd is not None
    assert not has_ended(pidfd)
    assert open_process(endpoint, domain + 1) is None
    with subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"]) as other:
        bits = (other.pid & 0xFFFF).to_bytes(2, "little")
        assert open_process(endpoint[:4] + bits + endpoint[6:], domain) is None, "a process without ROS"
        other.kill()
    assert open_process(b"\x01\x10" + endpoint[2:], domain) is None, "another vendor's id"
    server.stop(signal.SIGKILL)
    assert has_ended(pidfd)
    assert open_process(endpoint, domain) is None
    os.close(pidfd)


@pytest.mark.audit("dp-15")
def test_the_end_of_another_process_with_the_same_bits_is_no_death(mesh: Mesh, monkeypatch: pytest.MonkeyPatch) -> None:
    """A server in a container may share the bits of its process id with a ROS process of this host."""
    mesh.start()
    wrong = mesh.serve("--negate", "/negate", "--node", "wrong")
    mesh.wait_carried("/negate")
    ((wrong_id,),) = graph.server_endpoints(loop_of(mesh).node, ServiceName("/negate"), no_name, 0.0).values()

    monkeypatch.setattr(server_processes, "pid_bits", lambda _endpoint: dds_id.pid_bits(wrong_id))
    monkeypatch.setattr(
        server_processes, "open_process", lambda _endpoint, domain: process_finder.open_process(wrong_id, domain)
    )
    mesh.serve("--plan", "/plan")
    mesh.wait_carried("/plan", "/negate")
    wrong.stop(signal.SIGKILL)
    time.sleep(1.0)
    assert PLAN in mesh.link.carried
    assert mesh.result(mesh.call("/plan", "--count", "5"))["answered"] == 5
    assert RejectReason.SERVER_LOST not in [reason for reason, _ in mesh.link.refusals]


@pytest.mark.audit("dp-15")
def test_a_killed_server_whose_process_is_unknown(mesh: Mesh, monkeypatch: pytest.MonkeyPatch) -> None:
    blind(monkeypatch)
    mesh.start()
    server = mesh.serve("--plan", "/plan")
    mesh.wait_carried("/plan")
    mesh.call("/plan", "--count", "60", "--tolerance", "-1", "--timeout-s", "1")
    wait_until(lambda: mesh.cloud.stats.pending == 60, "60 requests in the cloud")
    server.stop(signal.SIGKILL)
    mesh.wait_carried()
    assert endpoints(mesh), "DDS noticed by itself: this shows nothing"
    # What waits is free to run elsewhere; what the server got is kept: it may only stand still.
    assert {reason for reason, _ in mesh.link.refusals} == {RejectReason.NOT_OFFERED}
    assert mesh.cloud.stats.pending == 60 - len(mesh.link.refusals)
    assert mesh.cloud.stats.pending >= 1


@pytest.mark.audit("dp-15")
@pytest.mark.parametrize(("is_known", "busy_s", "count"), [(False, 5, 3), (True, 4, 1)])
def test_a_slow_server_is_not_dead(
    mesh: Mesh, monkeypatch: pytest.MonkeyPatch, is_known: bool, busy_s: int, count: int
) -> None:
    """A planner that computes for seconds, and holds Python's interpreter lock meanwhile."""
    if not is_known:
        blind(monkeypatch)
    mesh.start()
    mesh.serve("--plan", "/plan", "--busy-s", str(busy_s))
    mesh.wait_carried("/plan")
    result = mesh.result(mesh.call("/plan", "--count", str(count), "--timeout-s", "25"))
    assert result["answered"] == count
    assert not mesh.link.refusals
    assert mesh.link.carried == {"/plan"}


@pytest.mark.audit("dp-15")
@pytest.mark.parametrize("is_known", [False, True])
def test_a_server_that_stands_still_is_used_again(mesh: Mesh, monkeypatch: pytest.MonkeyPatch, is_known: bool) -> None:
    if not is_known:
        blind(monkeypatch)
    mesh.start()
    server = mesh.serve("--plan", "/plan")
    mesh.wait_carried("/plan")
    assert mesh.result(mesh.call("/plan"))["answered"] == 1
    server.send(signal.SIGSTOP)
    mesh.call("/plan", "--count", "1", "--timeout-s", "1")
    mesh.wait_carried()
    assert mesh.cloud.stats.silent == {PLAN}
    server.send(signal.SIGCONT)
    mesh.wait_carried("/plan")
    assert not mesh.cloud.stats.silent
    assert mesh.result(mesh.call("/plan", "--count", "5"))["answered"] == 5


@pytest.mark.audit("dp-15")
def test_all_that_a_silent_process_serves_goes(mesh: Mesh) -> None:
    """Of one service it answered a request, of the other it never had one."""
    mesh.start()
    server = mesh.serve("--plan", "/plan", "--negate", "/negate")
    mesh.wait_carried("/negate", "/plan")
    assert mesh.result(mesh.call("/plan"))["answered"] == 1
    server.send(signal.SIGSTOP)
    stopped_at = time.monotonic()
    mesh.call("/plan", "--count", "1", "--timeout-s", "1")
    mesh.wait_carried()
    assert endpoints(mesh), "DDS noticed by itself: this shows nothing"
    assert time.monotonic() - stopped_at < LEASE_S
    server.send(signal.SIGCONT)
    mesh.wait_carried("/negate", "/plan")


@pytest.mark.audit("dp-15")
def test_a_server_that_hangs_and_is_killed_then(mesh: Mesh) -> None:
    """Its process is known: while it stands still, what it was handed may still run; once it ended, it may not."""
    mesh.start()
    server = mesh.serve("--plan", "/plan")
    mesh.wait_carried("/plan")
    assert mesh.result(mesh.call("/plan"))["answered"] == 1
    server.send(signal.SIGSTOP)
    stopped_at = time.monotonic()
    mesh.call("/plan", "--count", "60", "--tolerance", "-1", "--timeout-s", "1")
    wait_until(lambda: mesh.link.refusals, "refusals")
    mesh.wait_carried()
    assert {reason for reason, _ in mesh.link.refusals} == {RejectReason.NOT_OFFERED}
    kept = mesh.cloud.stats.pending
    assert 1 <= kept == 60 - len(mesh.link.refusals)
    assert kept <= 5, "what was not handed over before the silence was noticed is free"
    server.stop(signal.SIGKILL)
    wait_until(lambda: not mesh.cloud.stats.pending, "the rest")
    assert [reason for reason, _ in mesh.link.refusals].count(RejectReason.SERVER_LOST) == kept
    assert endpoints(mesh), "DDS noticed by itself: this shows nothing"
    assert time.monotonic() - stopped_at < LEASE_S


@pytest.mark.audit("dp-15")
@pytest.mark.parametrize("why", ["it waits for a processor", "it has only just started"])
def test_silence_that_tells_nothing_is_no_death(mesh: Mesh, monkeypatch: pytest.MonkeyPatch, why: str) -> None:
    """On a machine that is too busy nobody answers in time, nor finds the others in time."""
    mesh.start()
    server = mesh.serve("--plan", "/plan")
    mesh.wait_carried("/plan")
    if why == "it waits for a processor":
        monkeypatch.setattr("plr.sidecar.ros.cloud.server_processes.wants_processor", lambda _pidfd: True)
        assert mesh.result(mesh.call("/plan"))["answered"] == 1
    server.send(signal.SIGSTOP)
    program = mesh.call("/plan", "--timeout-s", "30")
    wait_until(lambda: mesh.cloud.stats.pending, "the request")
    time.sleep(3 * CALL_S + SILENCE_S)
    assert mesh.link.carried == {"/plan"}
    server.send(signal.SIGCONT)
    assert mesh.result(program)["answered"] == 1
    assert not mesh.link.refusals


@pytest.mark.audit("dp-15")
def test_who_wants_a_processor() -> None:
    begin = "print(flush=True)\n"
    for program, wants in (("while True: pass", True), ("import time; time.sleep(60)", False)):
        with subprocess.Popen([sys.executable, "-c", begin + program], stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            process.stdout.readline()
            pidfd = os.pidfd_open(process.pid)
            try:
                wait_until(lambda fd=pidfd, wants=wants: wants_processor(fd) is wants, program)  # type: ignore[misc]
                process.send_signal(signal.SIGSTOP)
                os.waitid(os.P_PID, process.pid, os.WSTOPPED)
                assert not wants_processor(pidfd)
            finally:
                process.kill()
            process.wait()
            assert not wants_processor(pidfd)
            os.close(pidfd)


@pytest.mark.audit("dp-15")
@pytest.mark.skipif(os.geteuid() != 0, reason="makes a process namespace")
def test_a_killed_server_in_another_process_namespace(mesh: Mesh) -> None:
    mesh.start()
    inside = [sys.executable, "-m", "tests.ros.app", "serve", "--plan", "/plan"]
    program = mesh.run(mesh.cloud_domain, *inside, module="tests.support.in_a_namespace")
    mesh.wait_carried("/plan")
    mesh.call("/plan", "--count", "60", "--tolerance", "-1", "--timeout-s", "1")
    wait_until(lambda: mesh.cloud.stats.pending == 60, "60 requests in the cloud")
    program.stop(signal.SIGKILL)
    mesh.wait_carried()
    assert endpoints(mesh), "DDS noticed by itself: this shows nothing"
    assert {reason for reason, _ in mesh.link.refusals} == {RejectReason.NOT_OFFERED}
