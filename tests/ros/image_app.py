"""An application and a server of the custom image service; run as `python -m tests.ros.image_app serve|call BYTES...`.

The server answers with the digest of the image; the application compares it, and prints how long each call took.
"""

from __future__ import annotations

import hashlib
import json
import random
import sys
import time
from typing import Any

import rclpy
from plr_demo_interfaces.srv import DetectPeople

SERVICE = "/detect"
WAIT_S = 30.0


def say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def serve() -> None:
    node = rclpy.create_node("image_server")

    def detect(request: Any, response: Any) -> Any:
        response.header = request.image.header
        response.success = True
        response.message = hashlib.sha256(request.image.data).hexdigest()
        return response

    node.create_service(DetectPeople, SERVICE, detect)
    say("ready")
    rclpy.spin(node)


def call(sizes: list[int]) -> None:
    node = rclpy.create_node("image_app")
    client = node.create_client(DetectPeople, SERVICE)
    assert client.wait_for_service(WAIT_S)
    took = []
    for number, size in enumerate(sizes):
        request = DetectPeople.Request()
        request.image.header.frame_id = f"frame {number}"
        request.image.data = random.Random(number).randbytes(size)
        began = time.monotonic()
        future = client.call_async(request)
        rclpy.spin_until_future_complete(node, future, timeout_sec=WAIT_S)
        took.append(time.monotonic() - began)
        response = future.result()
        assert response is not None, f"no answer to {size} bytes"
        assert response.header.frame_id == f"frame {number}"
        assert response.message == hashlib.sha256(request.image.data).hexdigest()
    say(json.dumps({"took_s": took}))


def main() -> None:
    rclpy.init(args=[])
    if sys.argv[1] == "serve":
        serve()
    else:
        call([int(size) for size in sys.argv[2:]])


if __name__ == "__main__":
    main()
