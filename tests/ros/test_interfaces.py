"""The example interface package: built, importable without any environment variable, and good on the wire."""

from __future__ import annotations

import subprocess
import sys
from typing import TYPE_CHECKING

import pytest
from plr_demo_interfaces.msg import Detection
from plr_demo_interfaces.srv import DetectPeople
from rclpy.serialization import deserialize_message, serialize_message

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.ros

IMAGE_BYTES = 150_000


def test_a_request_survives_the_wire() -> None:
    request = DetectPeople.Request()
    request.image.header.stamp.sec = 17
    request.image.header.frame_id = "camera"
    request.image.format = "jpeg"
    request.image.data = bytes(index % 251 for index in range(IMAGE_BYTES))
    serialised = serialize_message(request)
    assert IMAGE_BYTES < len(serialised) < IMAGE_BYTES + 100
    assert deserialize_message(serialised, DetectPeople.Request) == request


def test_a_response_survives_the_wire() -> None:
    response = DetectPeople.Response(success=True, message="", image_width=1280, image_height=820)
    response.header.frame_id = "camera"
    response.detections = [
        Detection(label="person", score=1.5, x=-3, y=4, width=50, height=100),
        Detection(label="chair", score=0.25, x=1_000, y=-1, width=1, height=2),
    ]
    response.processing_time.nanosec = 999_999_999
    again = deserialize_message(serialize_message(response), DetectPeople.Response)
    assert again == response
    assert again.detections[0].x == -3


def test_the_import_needs_no_environment(tmp_path: Path) -> None:
    run = subprocess.run(
        [
            sys.executable,
            "-c",
            "import plr_demo_interfaces.srv as s; print(s.DetectPeople.Request().image.format == '')",
        ],
        cwd=tmp_path,
        env={},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert run.stdout == "True\n", run.stderr
