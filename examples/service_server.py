"""What both example servers share: run one service until told to stop, if asked slower than need be."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from examples.stop_signal import StopSignal

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable

CHECK_PERIOD_S = 0.2


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options that both servers have."""
    parser.add_argument("--name", default=None, help="name of the ROS node")
    parser.add_argument(
        "--delay-ms",
        type=float,
        default=0.0,
        metavar="MS",
        help="be slower: sleep before answering (default %(default)s)",
    )
    parser.add_argument(
        "--delay-every", type=int, default=1, metavar="N", help="sleep only for each Nth request (default %(default)s)"
    )
    parser.add_argument("--journal", type=Path, metavar="FILE", help="append one JSON line for each request served")


class Server:
    """Answers one service: `answer(request, response)` returns the filled response and what to note in the journal."""

    def __init__(
        self,
        node: Any,
        service_type: Any,
        service: str,
        answer: Callable[[Any, Any], dict[str, Any]],
        options: argparse.Namespace,
    ) -> None:
        self.served = 0
        self._answer = answer
        self._delay_s = options.delay_ms / 1e3
        self._delay_every = max(1, options.delay_every)
        self._journal: TextIO | None = options.journal.open("a", encoding="utf-8") if options.journal else None
        node.create_service(service_type, service, self._serve)

    def _serve(self, request: Any, response: Any) -> Any:
        started = time.monotonic()
        self.served += 1
        if self._delay_s and self.served % self._delay_every == 0:
            time.sleep(self._delay_s)
        note = self._answer(request, response)
        if self._journal is not None:
            note |= {"started_s": started, "took_s": time.monotonic() - started}
            self._journal.write(json.dumps(note) + "\n")
            self._journal.flush()
        return response

    def close(self) -> None:
        """Close the journal."""
        if self._journal is not None:
            self._journal.close()


def run(
    name: str,
    service_type: Any,
    service: str,
    answer: Callable[[Any, Any], dict[str, Any]],
    options: argparse.Namespace,
) -> int:
    """Serve until interrupted. Returns the exit code."""
    stop = StopSignal()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node(options.name or name)
    server = Server(node, service_type, service, answer, options)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    print(f"serving {node.resolve_service_name(service)}", flush=True)
    try:
        while not stop.came:
            executor.spin_once(timeout_sec=CHECK_PERIOD_S)
    finally:
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()
        server.close()
        print(f"served {server.served} requests", flush=True)
    return 0
