"""Unmodified ROS applications for the bridge's tests; run as `python -m tests.ros.app serve|call OPTIONS`.

serve answers GetPlan with the pose it was asked from; the request's tolerance says how: n > 0 waits n seconds in the
background, so that answers overtake each other; 0 answers at once; below 0 never answers.
call sends requests numbered in start.pose.position.x and prints as JSON which answers came back.
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
import threading
import time
from collections import Counter
from typing import Any

import rclpy
from nav_msgs.srv import GetPlan
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from std_srvs.srv import SetBool

SERVICE_WAIT_S = 20.0
LINGER_S = 0.3
"""After the last answer, so that a second answer to a request is seen."""
DEEP = QoSProfile(depth=1000)
DEFAULT = QoSProfile(depth=10)
BEST_EFFORT = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)


def say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def serve(options: argparse.Namespace) -> None:
    node = rclpy.create_node(options.node, start_parameter_services=options.parameters)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    group = ReentrantCallbackGroup()  # the default group runs nothing else until the answer is there

    async def plan(request: Any, response: Any) -> Any:
        time.sleep(options.busy_s)  # noqa: ASYNC251 - a server that computes blocks its executor
        if request.tolerance < 0:
            await Future(executor=executor)
        elif request.tolerance > 0:
            due = Future(executor=executor)
            timer = node.create_timer(request.tolerance, lambda: due.done() or due.set_result(None), group)
            await due
            node.destroy_timer(timer)
        response.plan.header.frame_id = options.node
        response.plan.poses = [request.start]
        return response

    def negate(request: Any, response: Any) -> Any:
        response.success = not request.data
        response.message = options.node
        return response

    qos = BEST_EFFORT if options.best_effort else DEEP if options.deep else DEFAULT
    for name in options.plan:
        node.create_service(GetPlan, name, plan, qos_profile=qos, callback_group=group)
    for name in options.negate:
        node.create_service(SetBool, name, negate, qos_profile=qos)
    say("ready")
    executor.spin()


def call_raw(client: Any, requests: list[Any], timeout_s: float) -> dict[str, Any]:
    """Send all at once and count every answer that arrives, second ones too."""
    number_of = {client.handle.send_request(request): request.start.pose.position.x for request in requests}
    answers: Counter[float] = Counter()
    wrong = 0
    order = []
    end = time.monotonic() + timeout_s
    while time.monotonic() < end:
        header, response = client.handle.take_response(GetPlan.Response)
        if header is None:
            time.sleep(0.001)
            continue
        number = number_of[header.request_id.sequence_number]
        wrong += response.plan.poses[0].pose.position.x != number
        answers[number] += 1
        order.append(number)
        if len(order) == len(requests):
            end = min(end, time.monotonic() + LINGER_S)
    return {
        "answered": len(answers),
        "wrong": wrong,
        "twice": sum(count > 1 for count in answers.values()),
        "order": order,
    }


def call_plain(node: Any, client: Any, requests: list[Any], timeout_s: float) -> dict[str, Any]:
    """Send all at once, the way an rclpy application does it."""
    futures = [client.call_async(request) for request in requests]
    end = time.monotonic() + timeout_s
    while time.monotonic() < end and not all(future.done() for future in futures):
        rclpy.spin_once(node, timeout_sec=0.05)
    pairs = [(f.result().plan.poses[0], r.start) for f, r in zip(futures, requests, strict=True) if f.done()]
    return {"answered": len(pairs), "wrong": sum(got != asked for got, asked in pairs), "twice": 0}


def call(options: argparse.Namespace) -> None:
    node = rclpy.create_node(options.node, start_parameter_services=False)
    client = node.create_client(GetPlan, options.service, qos_profile=DEFAULT if options.plain else DEEP)
    if not client.wait_for_service(SERVICE_WAIT_S):
        raise SystemExit(f"no service {options.service}")
    requests = []
    for number in range(options.count):
        request = GetPlan.Request()
        request.start.pose.position.x = float(options.first + number)
        request.tolerance = options.tolerance[number % len(options.tolerance)]
        requests.append(request)
    began = time.monotonic()
    if options.plain:
        result = call_plain(node, client, requests, options.timeout_s)
    else:
        result = call_raw(client, requests, options.timeout_s)
    say(json.dumps({**result, "took_s": time.monotonic() - began}))


def main() -> None:
    parser = argparse.ArgumentParser()
    commands = parser.add_subparsers(required=True)
    server = commands.add_parser("serve")
    server.set_defaults(run=serve)
    server.add_argument("--node", default="test_server")
    server.add_argument("--plan", action="append", default=[])
    server.add_argument("--negate", action="append", default=[])
    server.add_argument("--busy-s", type=float, default=0.0, help="seconds of work that block the server")
    server.add_argument("--deep", action="store_true", help="a deep queue instead of the default profile")
    server.add_argument("--best-effort", action="store_true")
    server.add_argument("--parameters", action="store_true")
    client = commands.add_parser("call")
    client.set_defaults(run=call)
    client.add_argument("service")
    client.add_argument("--node", default="test_app")
    client.add_argument("--count", type=int, default=1)
    client.add_argument("--first", type=int, default=0)
    client.add_argument("--tolerance", type=float, nargs="+", default=[0.0])
    client.add_argument("--timeout-s", type=float, default=15.0)
    client.add_argument("--plain", action="store_true", help="default profile and rclpy's futures")
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: threading.Thread(target=rclpy.try_shutdown).start())
    rclpy.init(args=[])
    try:
        options.run(options)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
