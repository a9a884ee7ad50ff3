"""Real ROS 2 on a lab host: found on the same host, never on another."""

from __future__ import annotations

import subprocess
import sys

import pytest

from lab import Lab, LabConfig

pytestmark = [pytest.mark.netns, pytest.mark.ros]

SERVER = """
import rclpy
from std_srvs.srv import SetBool
rclpy.init()
node = rclpy.create_node("server")
def answer(request, response):
    response.success = request.data
    response.message = "from the server"
    return response
service = node.create_service(SetBool, "/switch", answer)
print("ready", flush=True)
rclpy.spin(node)
"""
CLIENT = """
import sys, rclpy
from std_srvs.srv import SetBool
rclpy.init()
node = rclpy.create_node("client")
client = node.create_client(SetBool, "/switch")
if not client.wait_for_service(timeout_sec=float(sys.argv[1])):
    sys.exit(3)
future = client.call_async(SetBool.Request(data=True))
rclpy.spin_until_future_complete(node, future, timeout_sec=20)
print(future.result().success, future.result().message)
"""


def test_ros_stays_on_its_host() -> None:
    with Lab(LabConfig.of(interfaces=("wlan0",), clouds=1)) as lab:
        robot, cloud = lab.host("robot"), lab.host("cloud_a")
        server = robot.popen([sys.executable, "-c", SERVER], stdout=subprocess.PIPE)
        assert server.stdout is not None
        assert server.stdout.readline() == b"ready\n"
        here = robot.run([sys.executable, "-c", CLIENT, "20"], timeout=60)
        assert here.stdout.strip() == "True from the server", here.stderr
        # By then the one above had long found it.
        assert cloud.run([sys.executable, "-c", CLIENT, "1.5"], timeout=60).returncode == 3
        robot.kill(server)
        server.stdout.close()
