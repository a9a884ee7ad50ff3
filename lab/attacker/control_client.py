"""A caller of the control plane that says what it likes, with the certificate it likes.

`python -m lab.attacker.control_client TARGET METHOD [--tls-dir DIR] [--stay S] < MESSAGES` sends lines of base64 as
messages of one call, then listens for S seconds, and prints one JSON object: how the call ended, how many answers came.
"""

from __future__ import annotations

import argparse
import base64
import json
import queue
import sys
import threading
from pathlib import Path
from typing import Any

import grpc

CONTROL_PLANE_DNS = "controlplane.plr.internal"
CONNECT = "/plr.v1.ControlPlane/Connect"


def open_channel(target: str, tls_dir: Path | None) -> grpc.Channel:
    """Return a channel; without a folder of certificates it speaks no TLS."""
    if tls_dir is None:
        return grpc.insecure_channel(target)
    credentials = grpc.ssl_channel_credentials(
        *((tls_dir / name).read_bytes() for name in ("ca.pem", "key.pem", "cert.pem"))
    )
    return grpc.secure_channel(target, credentials, [("grpc.ssl_target_name_override", CONTROL_PLANE_DNS)])


def call(channel: grpc.Channel, method: str, messages: list[bytes], stay_s: float) -> dict[str, Any]:
    """Send the messages, stay, and return what became of the call."""
    outgoing: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
    for message in messages:
        outgoing.put(message)
    open_stream: Any = channel.stream_stream(method)
    made = open_stream(iter(outgoing.get, None), wait_for_ready=False)
    ended = threading.Event()
    received: list[bytes] = []

    def read() -> None:
        try:
            received.extend(made)
        except grpc.RpcError:
            pass
        finally:
            ended.set()

    threading.Thread(target=read, daemon=True).start()
    lasted = not ended.wait(stay_s)
    if lasted:
        made.cancel()
        ended.wait(5.0)
    return {
        "code": "ok" if lasted else made.code().name.lower(),
        "details": "" if lasted else made.details(),
        "answers": [base64.b64encode(one).decode() for one in received],
    }


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("target")
    parser.add_argument("method")
    parser.add_argument("--tls-dir", type=Path)
    parser.add_argument("--stay", type=float, default=5.0, metavar="S")
    options = parser.parse_args()
    messages = [base64.b64decode(line) for line in sys.stdin]
    with open_channel(options.target, options.tls_dir) as channel:
        print(json.dumps(call(channel, options.method, messages, options.stay)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
