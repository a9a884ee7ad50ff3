"""A ROS application for tests and benchmarks: its answers, of a custom type, prove which request they belong to.

`python -m lab.echo serve` and `python -m lab.echo call --size 1000 --rate 50 --json FILE`.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
import time
import zlib
from pathlib import Path
from typing import Any

from plr_demo_interfaces.srv import DetectPeople

from examples import robot_client, service_server

SERVICE = "/echo"


def answer(request: Any, response: Any) -> dict[str, Any]:
    """Answer with a checksum of the payload, after as many milliseconds, and with as many bytes, as `format` says."""
    delay_ms, _, size = request.image.format.partition(" ")
    try:
        time.sleep(float(delay_ms or 0) / 1e3)
        response.message = "." * int(size or 0)
        response.success = True
    except (ValueError, OverflowError):  # a caller may also send nonsense
        response.success = False
    data = bytes(request.image.data)
    response.header = request.image.header
    response.image_width = zlib.crc32(data)
    response.image_height = len(data)
    return {"id": request.image.header.frame_id}


class Burden:
    """Slows a server down by the milliseconds in a file, as if others used it, more or fewer over time."""

    def __init__(self, file: Path) -> None:
        self._file = file

    def answer(self, request: Any, response: Any) -> dict[str, Any]:
        """Answer after the delay."""
        time.sleep(float(self._file.read_text(encoding="utf-8")) / 1e3)
        return answer(request, response)


class EchoRequests:
    """Requests of one size, each with different bytes."""

    def __init__(self, size: int, delay_ms: float, rng: random.Random, answer_bytes: tuple[int, int] = (0, 0)) -> None:
        """Prepare requests; `answer_bytes` bounds the sizes requested back, each order of magnitude equally likely."""
        self._size = size
        self._delay_ms = delay_ms
        self._rng = rng
        self._least, self._most = answer_bytes
        self._count = 0

    def request(self, stamp: Any) -> Any:
        request = DetectPeople.Request()
        request.image.header.stamp = stamp
        request.image.header.frame_id = f"{self._count}"
        self._count += 1
        ratio = self._most / self._least if self._least else 0.0
        back = round(self._least * ratio ** self._rng.random())
        request.image.format = f"{self._delay_ms:g} {back}"
        request.image.data = self._rng.randbytes(self._size)
        return request

    def check(self, request: Any, response: Any) -> tuple[str | None, dict[str, float]]:
        mine = response.header == request.image.header
        if not mine or response.image_width != zlib.crc32(bytes(request.image.data)):
            return "answer to another request", {}
        if response.message != "." * int(request.image.format.partition(" ")[2]):
            return "another answer than was asked for", {}
        return None, {}


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    serve = commands.add_parser("serve")
    service_server.add_arguments(serve)
    serve.add_argument("--service", default=SERVICE, metavar="NAME", help="serve it under this name (%(default)s)")
    serve.add_argument(
        "--burden", type=Path, metavar="FILE", help="answer later by the milliseconds that this file holds"
    )
    call = commands.add_parser("call")
    robot_client.add_arguments(call, rate_hz=50.0, deadline_ms=500.0)
    call.add_argument("--size", type=int, default=1000)
    call.add_argument(
        "--ask-delay-ms", type=float, default=0.0, help="milliseconds that the server takes for each request"
    )
    call.add_argument("--service", default=SERVICE, metavar="NAME", help="call the service of this name (%(default)s)")
    call.add_argument(
        "--answer-bytes",
        type=int,
        nargs=2,
        default=(0, 0),
        metavar=("LEAST", "MOST"),
        help="additional bytes of each answer (default none)",
    )
    options = parser.parse_args()
    if options.command == "serve":
        serving = answer if options.burden is None else Burden(options.burden).answer
        return service_server.run("echo", DetectPeople, options.service, serving, options)
    back = (options.answer_bytes[0], options.answer_bytes[1])
    workload = EchoRequests(options.size, options.ask_delay_ms, random.Random(options.seed), back)
    return robot_client.run("caller", DetectPeople, options.service, workload, options)


def journal_ids(path: Path) -> list[str]:
    """Return the requests that a server ran, in order."""
    return [json.loads(line)["id"] for line in path.read_text().splitlines()] if path.exists() else []


if __name__ == "__main__":
    sys.exit(main())
