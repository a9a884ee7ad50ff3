"""Runs unmodified ROS 2: an rclpy client that calls the echo service (`lab.echo`) of any server."""

from __future__ import annotations

import threading
import time
from typing import Any

import rclpy
from plr_demo_interfaces.srv import DetectPeople
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from bench.dataplane.calling import HEADER, Caller, Plan, usage
from bench.dataplane.remote import serve
from lab.echo import SERVICE

SERVER_TIMEOUT_S = 40.0


class RosProgram:
    """A client."""

    def __init__(self) -> None:
        self._caller = Caller(self._send)
        self._format = ""
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        self._node = rclpy.create_node("evaluation")
        self._client = self._node.create_client(DetectPeople, SERVICE)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        threading.Thread(target=self._executor.spin, daemon=True).start()

    def connect(self, answer_bytes: int, compute_s: float) -> None:
        """Wait for a server; each request asks it for an answer of this length after this time."""
        self._format = f"{compute_s * 1e3:g} {answer_bytes}"
        if not self._client.wait_for_service(timeout_sec=SERVER_TIMEOUT_S):
            raise TimeoutError(f"no server of {SERVICE}")

    def call(self, **plan: Any) -> dict[str, Any]:
        """Send a plan's requests."""
        return self._caller.call(Plan(**plan))

    def usage(self) -> dict[str, float]:
        """Return processor seconds and peak of resident bytes."""
        return usage()

    def close(self) -> None:
        """End."""
        self._executor.shutdown()
        rclpy.try_shutdown()

    def _send(self, number: int, data: bytes) -> None:
        request = DetectPeople.Request()
        request.image.header.frame_id = str(number)
        request.image.format = self._format
        request.image.data = data
        header = data[: HEADER.size]
        self._client.call_async(request).add_done_callback(lambda done: self._answered(number, header, done.result()))

    def _answered(self, number: int, header: bytes, response: Any) -> None:
        if response.header.frame_id != str(number):
            raise RuntimeError(f"request {number} got the answer to {response.header.frame_id}")
        self._caller.answered(header, time.monotonic())


if __name__ == "__main__":
    serve(RosProgram())
