"""A robot that sends a camera frame to /detect_people (plr_demo_interfaces/srv/DetectPeople) five times a second.

Frames are JPEGs of 1280x820 pixels, 100 to 150 kB. It never waits for an answer before it sends the next frame, checks
that each answer belongs to its frame, and exits with 0 only if every frame was answered exactly once and rightly.

examples:
  python -m examples.human_detection.client --duration 60
  python -m examples.human_detection.client --rate 10 --deadline-ms 250 --json run.json
  python -m examples.human_detection.client --save frame.jpg        # what the camera sees, then stop
"""

from __future__ import annotations

import argparse
import itertools
import sys
from pathlib import Path
from typing import Any

from plr_demo_interfaces.srv import DetectPeople

from examples import robot_client
from examples.human_detection import camera

SERVICE = "/detect_people"
# A box counts as a find of a person whose own box it overlaps at least this much.
MIN_OVERLAP = 0.5


class FrameRequests:
    """Sends the frames of a film, over and over, each with a stamp of its own."""

    def __init__(self, frames: list[camera.Frame]) -> None:
        self._frames = itertools.cycle(frames)
        self._shown: dict[tuple[int, int], camera.Frame] = {}

    def request(self, stamp: Any) -> Any:
        """A request with the next frame."""
        frame = next(self._frames)
        request = DetectPeople.Request()
        request.image.header.stamp = stamp
        request.image.header.frame_id = "camera"
        request.image.format = "jpeg"
        request.image.data = frame.jpeg
        self._shown[stamp.sec, stamp.nanosec] = frame
        return request

    def check(self, request: Any, response: Any) -> tuple[str | None, dict[str, float]]:
        """See `robot_client.Workload.check`. The stamp tells the frame; people must be where they are in it."""
        stamp = request.image.header.stamp
        frame = self._shown.pop((stamp.sec, stamp.nanosec))
        if response.header != request.image.header:
            return "answer to another frame", {}
        if not response.success:
            return f"server: {response.message}", {}
        if (response.image_width, response.image_height) != (camera.WIDTH, camera.HEIGHT):
            return "wrong image size", {}
        found = [camera.Box(box.x, box.y, box.width, box.height) for box in response.detections]
        detail = {
            "people": float(len(frame.people)),
            "people_found": float(
                sum(any(person.overlap(box) >= MIN_OVERLAP for box in found) for person in frame.people)
            ),
            "processing_ms": response.processing_time.sec * 1e3 + response.processing_time.nanosec / 1e6,
        }
        return (None if detail["people_found"] else "nobody found who is there"), detail


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        prog="python -m examples.human_detection.client",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    robot_client.add_arguments(parser, rate_hz=5.0, deadline_ms=300.0)
    parser.add_argument("--image", type=Path, metavar="FILE", help="another photograph for the wall")
    parser.add_argument("--frames", type=int, default=20, help="length of the film (default %(default)s)")
    parser.add_argument("--save", type=Path, metavar="FILE", help="write one frame to this file and stop")
    options = parser.parse_args()
    try:
        frames = camera.film(max(1, options.frames), options.seed, options.image)
    except ValueError as error:
        parser.error(str(error))
    if options.save is not None:
        options.save.write_bytes(frames[0].jpeg)
        return 0
    return robot_client.run("robot", DetectPeople, SERVICE, FrameRequests(frames), options)


if __name__ == "__main__":
    sys.exit(main())
