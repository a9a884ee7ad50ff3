"""What the ROS bridge costs: calls of an empty service, direct, through wait loops of several kinds, and through two
bridges that are joined without a network.

    python -m bench.bridge_speed [--calls 2000] [--services 1 20 100] [--period-ms 0 10] [--only KIND ...]

Each row: median, P99 and maximum of the caller's time, and the CPU time per call of the process under test. The caller
and the service are processes of their own; the caller waits on one entity with a bare wait set, so that its own cost
is small and the same in all rows.

    direct       rclpy.spin and a plain callback: what an unmodified server costs
    executor     rclpy.spin; the callback serialises and deserialises request and response, as a bridge does
    wait-set     the same in a loop over one wait set
    wait-set-2   the same; a second thread answers
    wait-set-rcl the loop over one wait set, with rcl's C functions instead of rclpy's messages: what the bridge does
    two-bridges  a robot's and a cloud's bridge in one process, before a `direct` server in a second
"""

from __future__ import annotations

import argparse
import contextlib
import os
import queue
import resource
import subprocess
import sys
import threading
import time
from typing import TYPE_CHECKING, Any

import rclpy
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.type_support import check_for_type_support
from std_srvs.srv import Empty

from plr.protos.model.ids import NodeName, Role, ServiceName, SessionId
from plr.protos.program import interpreter
from plr.sidecar.core.base.values import ExecutionId, Priority
from plr.sidecar.core.rules.service_rule import ServiceRule
from plr.sidecar.core.seam.application import ExecuteRequest, OfferService, RequestFailed, ResponseArrived
from plr.sidecar.ros import rcl

if TYPE_CHECKING:
    from collections.abc import Iterator

    from plr.protos.model.members import ServiceOffer
    from plr.sidecar.core.base.values import RejectReason, RequestId
    from plr.sidecar.core.seam.application import CarriedService
    from plr.sidecar.ros.bridge import RosBridge

CALLED_SERVICES = 4
"""Services that the caller calls in rotation; the others are only present."""
WARM_UP_CALLS = 200
CALL_TIMEOUT_S = 2.0
FIRST_DOMAIN = 90


def say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def bounce(request: Any) -> Any:
    """Do what a pair of bridges does to an empty request and its response."""
    deserialize_message(serialize_message(request), Empty.Request)
    return deserialize_message(serialize_message(Empty.Response()), Empty.Response)


def service_names(count: int) -> list[str]:
    return [f"/s{number}" for number in range(count)]


# -- the process under test ----------------------------------------------------------------------------------------


def report_cpu_on_request() -> None:
    """Print the CPU time used so far for each line of standard input; end when it ends."""
    for _ in sys.stdin:
        usage = resource.getrusage(resource.RUSAGE_SELF)
        say(str(usage.ru_utime + usage.ru_stime))
    os._exit(0)


def serve(kind: str, services: int) -> None:
    rclpy.init(args=[])
    node = rclpy.create_node("bench_server", start_parameter_services=False, enable_rosout=False)
    for generated in (Empty, Empty.Request, Empty.Response):
        check_for_type_support(generated)

    def plain(_request: Any, response: Any) -> Any:
        return response

    def bouncing(request: Any, _response: Any) -> Any:
        return bounce(request)

    callback = bouncing if kind == "executor" else plain
    handles = [node.create_service(Empty, name, callback).handle for name in service_names(services)]
    threading.Thread(target=report_cpu_on_request, daemon=True).start()
    say("ready")
    if kind in ("direct", "executor"):
        rclpy.spin(node)
    else:
        spin_wait_set(kind, handles, rclpy.get_default_context())


def spin_wait_set(kind: str, handles: list[Any], context: Any) -> None:
    by_pointer = {handle.pointer: handle for handle in handles}
    wait_set = _rclpy.WaitSet(0, 1, 0, 0, len(handles), 0, context.handle)
    guard = _rclpy.GuardCondition(context.handle)
    answers: queue.SimpleQueue[tuple[Any, bytes, Any]] = queue.SimpleQueue()
    request_type, response_type = rcl.MessageType(Empty.Request), rcl.MessageType(Empty.Response)
    empty_response = serialize_message(Empty.Response())

    def answer_all() -> None:
        while True:
            handle, payload, request_id = answers.get()
            deserialize_message(payload, Empty.Request)
            response = deserialize_message(serialize_message(Empty.Response()), Empty.Response)
            handle.service_send_response(response, request_id)

    if kind == "wait-set-2":
        threading.Thread(target=answer_all, daemon=True).start()
    while True:
        wait_set.clear_entities()
        wait_set.add_guard_condition(guard)
        for handle in handles:
            wait_set.add_service(handle)
        wait_set.wait(10**9)
        for pointer in wait_set.get_ready_entities("service"):
            if kind == "wait-set-rcl":
                while (taken := rcl.take_request(pointer, request_type)) is not None:
                    request_type.deserialize(taken[1])
                    answer = response_type.serialize(response_type.deserialize(empty_response))
                    rcl.send_response(pointer, taken[0], response_type.deserialize(answer))
                continue
            handle = by_pointer[pointer]
            while True:
                request, header = handle.service_take_request(Empty.Request)
                if header is None:
                    break
                if kind == "wait-set-2":
                    answers.put((handle, serialize_message(request), header.request_id))
                else:
                    handle.service_send_response(bounce(request), header.request_id)


class Shortcut:
    """The data planes of two bridges, joined by plain calls."""

    def __init__(self) -> None:
        self.session = SessionId(1)
        self.robot: RosBridge | None = None
        self.cloud: RosBridge | None = None
        self.carried: frozenset[ServiceName] = frozenset()
        self._requests: dict[ExecutionId, tuple[RequestId, ServiceName]] = {}
        self._count = 0

    def submit(self, request_id: RequestId, service: ServiceName, payload: bytes) -> None:
        self._count += 1
        execution = ExecutionId(self._count)
        self._requests[execution] = (request_id, service)
        assert self.cloud is not None
        self.cloud.handle(
            ExecuteRequest(
                execution,
                service,
                "std_srvs/srv/Empty",
                payload,
                NodeName("robot"),
                Priority.NORMAL,
                1.0,
                CALL_TIMEOUT_S,
            )
        )

    def judge_answer(self, request_id: RequestId, copy: int, problem: str | None) -> None:
        assert problem is None

    def answered_locally(self, request_id: RequestId) -> None:
        raise AssertionError("nothing has a fallback here")

    def complete(self, execution: ExecutionId, payload: bytes, processing_s: float) -> None:
        request_id, service = self._requests.pop(execution)
        assert self.robot is not None
        self.robot.handle(
            ResponseArrived(request_id, service, 0, payload, NodeName("cloud"), INTERFACE, processing_s, late=False)
        )

    def refuse(self, execution: ExecutionId, reason: RejectReason, detail: str) -> None:
        request_id, service = self._requests.pop(execution)
        assert self.robot is not None
        self.robot.handle(RequestFailed(request_id, service, "rejected", f"{reason.name}: {detail}", 0.0))

    def set_offers(self, offers: tuple[ServiceOffer, ...]) -> None:
        assert self.robot is not None
        for offer in offers:
            self.robot.handle(OfferService(offer.name, offer.type))

    def set_carried(self, services: frozenset[CarriedService]) -> None:
        self.carried = frozenset(service.name for service in services)


def run_bridges(services: int) -> None:
    """Proxy ROS_DOMAIN_ID's services into the next domain."""
    from plr.sidecar.ros.bridge import RosBridge

    interpreter.share()
    rules = (ServiceRule("/s*", deadline_s=1.0, lifetime_s=CALL_TIMEOUT_S),)
    domain = int(os.environ["ROS_DOMAIN_ID"])
    joined = Shortcut()
    joined.robot = RosBridge(name="robot", role=Role.ROBOT, rules=rules, domain_id=domain + 1)
    joined.cloud = RosBridge(name="cloud", role=Role.CLOUD, rules=rules, domain_id=domain)
    joined.robot.start(joined)
    joined.cloud.start(joined)
    while len(joined.carried) < services:
        time.sleep(0.05)
    say("ready")
    report_cpu_on_request()


# -- the caller --------------------------------------------------------------------------------------------------------


class Child:
    """One of the processes under test."""

    def __init__(self, *arguments: str, domain: int) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "bench.bridge_speed", *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "ROS_DOMAIN_ID": str(domain)},
        )
        assert self._line() == "ready"

    def cpu_s(self) -> float:
        assert self.process.stdin is not None
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        return float(self._line())

    def _line(self) -> str:
        assert self.process.stdout is not None
        return self.process.stdout.readline().strip()


@contextlib.contextmanager
def children(kind: str, services: int) -> Iterator[tuple[Child, int]]:
    """Yield (the process under test, the domain to call in)."""
    started: list[Child] = []
    try:
        if kind == "two-bridges":
            started.append(Child("--serve", "direct", "--services", str(services), domain=FIRST_DOMAIN))
            started.append(Child("--serve", kind, "--services", str(services), domain=FIRST_DOMAIN))
            yield started[-1], FIRST_DOMAIN + 1
        else:
            started.append(Child("--serve", kind, "--services", str(services), domain=FIRST_DOMAIN))
            yield started[-1], FIRST_DOMAIN
    finally:
        for child in started:
            child.process.kill()
            child.process.communicate()


def measure(kind: str, services: int, calls: int, period_s: float) -> str:
    with children(kind, services) as (tested, domain):
        context = rclpy.Context()
        rclpy.init(args=[], context=context, domain_id=domain)
        node = rclpy.create_node("bench_caller", context=context, start_parameter_services=False, enable_rosout=False)
        clients = [node.create_client(Empty, name) for name in service_names(services)[:CALLED_SERVICES]]
        assert all(client.wait_for_service(20.0) for client in clients)
        time.sleep(0.5)
        wait_set = _rclpy.WaitSet(0, 0, 0, 1, 0, 0, context.handle)

        def call(handle: Any) -> float:
            began = time.perf_counter()
            handle.send_request(Empty.Request())
            while True:
                wait_set.clear_entities()
                wait_set.add_client(handle)
                wait_set.wait(int(CALL_TIMEOUT_S * 1e9))
                header, _ = handle.take_response(Empty.Response)
                took = time.perf_counter() - began
                if header is not None or took > CALL_TIMEOUT_S:
                    return took

        for number in range(WARM_UP_CALLS):
            call(clients[number % len(clients)].handle)
        cpu_s = tested.cpu_s()
        took = []
        for number in range(calls):
            took.append(call(clients[number % len(clients)].handle))
            if period_s:
                time.sleep(period_s)
        cpu_s = tested.cpu_s() - cpu_s
        node.destroy_node()
        context.shutdown()
    took.sort()
    figures = (took[calls // 2], took[int(calls * 0.99)], took[-1], cpu_s / calls)
    cells = " | ".join(f"{figure * 1e6:6.0f}" for figure in figures)
    return f"| {kind:12} | {services:8} | {period_s * 1e3:9g} | {cells} |"


INTERFACE: Any = "lo"
KINDS = ("direct", "executor", "wait-set", "wait-set-2", "wait-set-rcl", "two-bridges")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--serve", choices=KINDS, help=argparse.SUPPRESS)
    parser.add_argument("--calls", type=int, default=2000)
    parser.add_argument("--services", type=int, nargs="+", default=[1, 20, 100])
    parser.add_argument("--period-ms", type=float, nargs="+", default=[0.0])
    parser.add_argument("--only", choices=KINDS, nargs="+", default=list(KINDS))
    options = parser.parse_args()
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    if options.serve == "two-bridges":
        run_bridges(options.services[0])
    elif options.serve:
        serve(options.serve, options.services[0])
    else:
        say("| kind         | services | period ms | median us | P99 us | max us | CPU us |")
        say("| ------------ | -------- | --------- | ------ | ------ | ------ | ------ |")
        for period_ms in options.period_ms:
            for services in options.services:
                for kind in options.only:
                    say(measure(kind, services, options.calls, period_ms / 1e3))


if __name__ == "__main__":
    main()
