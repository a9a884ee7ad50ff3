"""ROS nodes for the tests of the sidecar's DDS environment; run as a program, each in its own environment.

dds_probe.py serve          offers a service until standard input closes
dds_probe.py call COUNT     calls it; prints how many calls were answered
dds_probe.py sniff SECONDS  in a network namespace of its own: prints how many UDP packets of a node left the host
"""

from __future__ import annotations

import socket
import subprocess
import sys
import threading
import time

import rclpy
from std_srvs.srv import Trigger

SERVICE = "/dds_probe"
PAYLOAD_CHARACTERS = 150_000
WAIT_S = 15.0


def say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def serve() -> None:
    rclpy.init()
    node = rclpy.create_node("dds_probe_server")

    def answer(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.message = "x" * PAYLOAD_CHARACTERS
        return response

    node.create_service(Trigger, SERVICE, answer)
    threading.Thread(target=lambda: (sys.stdin.read(), rclpy.try_shutdown()), daemon=True).start()
    say("ready")
    while rclpy.ok():
        rclpy.spin_once(node, timeout_sec=0.1)


def call(count: int) -> None:
    rclpy.init()
    node = rclpy.create_node("dds_probe_client")
    client = node.create_client(Trigger, SERVICE)
    answered = 0
    if client.wait_for_service(timeout_sec=WAIT_S):
        for _ in range(count):
            future = client.call_async(Trigger.Request())
            rclpy.spin_until_future_complete(node, future, timeout_sec=WAIT_S)
            if not future.done():
                break
            answered += len(future.result().message) == PAYLOAD_CHARACTERS
    node.destroy_node()
    rclpy.shutdown()
    say(f"answered {answered}")


def sniff(seconds: float) -> None:
    for command in (
        "ip link set lo up",
        "ip link add inside type veth peer name outside",
        "ip address add 10.77.0.1/24 dev inside",
        "ip link set inside up",
        "ip link set outside up",
        "ip route add default via 10.77.0.2 dev inside",
    ):
        subprocess.run(command.split(), check=True)
    left = 0
    with socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(0x0800)) as wire:
        wire.bind(("outside", 0x0800))
        wire.settimeout(0.1)
        rclpy.init()
        node = rclpy.create_node("dds_probe_talker")
        node.create_service(Trigger, SERVICE, lambda _, response: response)
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            rclpy.spin_once(node, timeout_sec=0.05)
            try:
                frame = wire.recv(2048)
            except TimeoutError:
                continue
            left += frame[23] == socket.IPPROTO_UDP
        node.destroy_node()
        rclpy.shutdown()
    say(f"left {left}")


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["serve"]:
            serve()
        case ["call", count]:
            call(int(count))
        case ["sniff", seconds]:
            sniff(float(seconds))
        case _:
            sys.exit(__doc__)
