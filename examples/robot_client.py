"""What both example robots share: call a service at a fixed rate and account for every answer."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions

from examples.request_log import RequestLog, RequestRecord
from examples.stop_signal import StopSignal

if TYPE_CHECKING:
    from collections.abc import Callable

# How often the robot looks whether the run is over, and how often it tells how things stand.
CHECK_PERIOD_S = 0.05
PROGRESS_PERIOD_S = 1.0
# Steps of the executor for each request when the robot is behind: an answer takes three (take it, forget the pending
# request, check it), and there must be some to catch up with.
STEPS_A_REQUEST = 6

EXIT_OK, EXIT_FLAWED, EXIT_INTERRUPTED = 0, 1, 130


class Workload(Protocol):
    """What a robot asks, and how it checks the answer."""

    def request(self, stamp: Any) -> Any:
        """A new service request, stamped with the ROS time at which it goes out."""

    def check(self, request: Any, response: Any) -> tuple[str | None, dict[str, float]]:
        """What is wrong with the answer to `request` (None if nothing is), and figures to keep with it."""


def add_arguments(parser: argparse.ArgumentParser, *, rate_hz: float, deadline_ms: float) -> None:
    """The options that both robots have."""
    parser.add_argument(
        "--rate", type=positive, default=rate_hz, metavar="HZ", help="requests a second (default %(default)s)"
    )
    parser.add_argument(
        "--duration", type=positive, default=30.0, metavar="S", help="seconds of requests (default %(default)s)"
    )
    parser.add_argument(
        "--deadline-ms",
        type=positive,
        default=deadline_ms,
        metavar="MS",
        help="count later answers as late (default %(default)s)",
    )
    parser.add_argument(
        "--wait-s",
        type=positive,
        default=30.0,
        metavar="S",
        help="wait for a server at most this long (default %(default)s)",
    )
    parser.add_argument(
        "--grace-s",
        type=positive,
        default=5.0,
        metavar="S",
        help="wait for late answers at the end (default %(default)s)",
    )
    parser.add_argument(
        "--queue-depth",
        type=int,
        default=10,
        metavar="N",
        help="answers kept until the robot looks at them; more at once push the oldest out (default %(default)s)",
    )
    parser.add_argument("--json", type=Path, metavar="OUT", help="write every request's record to this file")
    parser.add_argument("--seed", type=int, default=1, help="seed of what is asked (default %(default)s)")
    parser.add_argument("--quiet", action="store_true", help="no progress lines")


def positive(text: str) -> float:
    """A positive number from the command line."""
    value = float(text)
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"expected a positive number, not {text}")
    return value


class RobotClient:
    """Calls a service at a fixed rate without ever waiting for an answer, and keeps a log of all calls."""

    def __init__(
        self, node: Any, service_type: Any, service: str, workload: Workload, deadline_ms: float, queue_depth: int
    ) -> None:
        self.log = RequestLog(service, deadline_ms)
        self._node = node
        self._workload = workload
        qos = QoSProfile(depth=queue_depth)  # otherwise as rclpy's default for services: reliable, volatile
        self._client = node.create_client(service_type, service, qos_profile=qos)
        self._waiting: dict[Any, RequestRecord] = {}
        self._answered: dict[int, RequestRecord] = {}
        # rclpy asks this for the future of each response that arrives, and drops the response silently if there is
        # none. It is the one place where a second answer to the same request can be seen.
        self._find_pending: Callable[[int], Any] = self._client.get_pending_request
        self._client.get_pending_request = self._response_arrived

    def wait_for_server(self, timeout_s: float, stop: StopSignal) -> bool:
        """Whether a server for the service was found in time, and before the stop."""
        end = time.monotonic() + timeout_s
        while not (found := bool(self._client.wait_for_service(timeout_sec=CHECK_PERIOD_S))):
            if stop.came or time.monotonic() > end:
                break
        return found

    def send(self) -> None:
        """Send the next request."""
        request = self._workload.request(self._node.get_clock().now().to_msg())
        record = self.log.sent(time.monotonic(), time.time())
        future = self._client.call_async(request)
        self._waiting[future] = record
        future.add_done_callback(lambda done: self._check(record, request, done.result()))

    def _response_arrived(self, sequence_number: int) -> Any:
        now = time.monotonic()
        try:
            future = self._find_pending(sequence_number)
        except KeyError:
            future = None
        record = self._waiting.pop(future, None) or self._answered.get(sequence_number)
        if record is None:
            self.log.strangers += 1
            raise KeyError(sequence_number)
        self._answered[sequence_number] = record
        self.log.answered(record, now)
        if future is None:
            raise KeyError(sequence_number)
        return future

    def _check(self, record: RequestRecord, request: Any, response: Any) -> None:
        record.problem, record.detail = self._workload.check(request, response)


def run(name: str, service_type: Any, service: str, workload: Workload, options: argparse.Namespace) -> int:
    """Run a robot until its time is over or it is interrupted. Returns the exit code."""
    stop = StopSignal()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node(name)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    robot = RobotClient(node, service_type, service, workload, options.deadline_ms, options.queue_depth)
    try:
        if not robot.wait_for_server(options.wait_s, stop):
            if stop.came:
                return EXIT_INTERRUPTED
            print(f"no server for {service} within {options.wait_s:g} s")
            return EXIT_FLAWED
        _drive(executor, robot, options, stop)
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()
    _report(robot.log, options)
    if stop.came:
        return EXIT_INTERRUPTED
    return EXIT_OK if robot.log.flawless() else EXIT_FLAWED


def _drive(executor: Any, robot: RobotClient, options: argparse.Namespace, stop: StopSignal) -> None:
    """Send at the rate for the duration, then wait for what is still missing; ends early when told to stop."""
    period_s = 1.0 / options.rate
    count = max(1, round(options.duration * options.rate))
    start = time.monotonic()
    end = start + options.duration + options.grace_s
    next_progress = start + PROGRESS_PERIOD_S
    while (now := time.monotonic()) < end and not stop.came:
        sent = len(robot.log.records)
        if sent == count and robot.log.missing == 0:
            break
        # The rate holds on average: a request that the machine delayed is made up for, yet never before the answers
        # that are there have been looked at.
        next_due = start + sent * period_s if sent < count else end
        if now >= next_due:
            robot.send()
            _handle_waiting(executor)
        else:
            executor.spin_once(timeout_sec=min(next_due - now, CHECK_PERIOD_S))
        if now >= next_progress and not options.quiet:
            print(robot.log.progress(now - start, now - PROGRESS_PERIOD_S), flush=True)
            next_progress = now + PROGRESS_PERIOD_S
    # A second answer to the last requests would come about now.
    settle = time.monotonic() + period_s
    while time.monotonic() < settle and not stop.came:
        executor.spin_once(timeout_sec=CHECK_PERIOD_S)


def _handle_waiting(executor: Any) -> None:
    """Handle what has arrived; each answer takes rclpy several steps."""
    for _ in range(STEPS_A_REQUEST):
        executor.spin_once(timeout_sec=0)


def _report(log: RequestLog, options: argparse.Namespace) -> None:
    summary = log.summary()
    print(
        f"{summary['sent']} requests to {log.service}: {summary['answered_once']} answered once, "
        f"{summary['missing']} not at all, {summary['answered_twice']} more than once, {summary['invalid']} wrongly, "
        f"{summary['deadline_missed']} not within {log.deadline_ms:g} ms"
    )
    if summary["mean_ms"] is not None:
        print(
            f"latency: mean {summary['mean_ms']:.1f} ms, median {summary['p50_ms']:.1f} ms, "
            f"P99 {summary['p99_ms']:.1f} ms, worst {summary['max_ms']:.1f} ms"
        )
    if options.json is not None:
        log.write_json(options.json)
