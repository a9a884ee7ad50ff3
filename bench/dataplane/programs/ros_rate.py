"""A ROS client that keeps so many calls of the echo service in flight: prints how many are answered in a second."""

from __future__ import annotations

import argparse
import random
import time
from typing import Any

import rclpy
from plr_demo_interfaces.srv import DetectPeople
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile

from lab.echo import SERVICE, EchoRequests

WAIT_S = 30.0
CHECK_PERIOD_S = 0.05


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=1000, help="bytes of each request (default %(default)s)")
    parser.add_argument("--at-once", type=int, default=16, help="calls in flight (default %(default)s)")
    parser.add_argument("--seconds", type=float, default=3.0, help="how long (default %(default)s)")
    options = parser.parse_args()
    rclpy.init()
    node = rclpy.create_node("rate")
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    client = node.create_client(DetectPeople, SERVICE, qos_profile=QoSProfile(depth=2 * options.at_once))
    if not client.wait_for_service(timeout_sec=WAIT_S):
        raise SystemExit("no server")
    workload = EchoRequests(options.size, 0.0, random.Random(1))
    answered = 0

    def send() -> None:
        client.call_async(workload.request(node.get_clock().now().to_msg())).add_done_callback(on_answer)

    def on_answer(_future: Any) -> None:
        nonlocal answered
        answered += 1
        if time.monotonic() < end:
            send()

    start = time.monotonic()
    end = start + options.seconds
    for _ in range(options.at_once):
        send()
    while time.monotonic() < end:
        executor.spin_once(timeout_sec=CHECK_PERIOD_S)
    print(answered / (time.monotonic() - start))
    executor.shutdown()
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
