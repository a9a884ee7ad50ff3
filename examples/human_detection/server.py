"""Human detection server: answers plr_demo_interfaces/srv/DetectPeople at /detect_people with OpenCV's HOG detector.

examples:
  python -m examples.human_detection.server
  python -m examples.human_detection.server --threads 2
  python -m examples.human_detection.server --delay-ms 2000 --delay-every 20   # now and then very slow
"""

from __future__ import annotations

import argparse
import sys
import time
from typing import Any

import cv2
from builtin_interfaces.msg import Duration
from plr_demo_interfaces.msg import Detection
from plr_demo_interfaces.srv import DetectPeople

from examples import service_server
from examples.human_detection.detector import PeopleDetector

SERVICE = "/detect_people"


class DetectionService:
    """Answers DetectPeople requests."""

    def __init__(self) -> None:
        self._detector = PeopleDetector()

    def answer(self, request: Any, response: Any) -> dict[str, Any]:
        """Fill the response with the people found, or with why none could be looked for."""
        started = time.monotonic_ns()
        response.header = request.image.header
        try:
            size, people = self._detector.find(request.image.data.tobytes())
        except ValueError as error:
            response.success, response.message = False, str(error)
            people = []
        else:
            response.success = True
            response.image_width, response.image_height = size
            response.detections = [
                Detection(
                    label="person",
                    score=person.score,
                    x=person.x,
                    y=person.y,
                    width=person.width,
                    height=person.height,
                )
                for person in people
            ]
        seconds, nanoseconds = divmod(time.monotonic_ns() - started, 10**9)
        response.processing_time = Duration(sec=seconds, nanosec=nanoseconds)
        stamp = request.image.header.stamp
        return {
            "stamp": [stamp.sec, stamp.nanosec],
            "bytes": len(request.image.data),
            "people": len(people),
        }


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        prog="python -m examples.human_detection.server",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    service_server.add_arguments(parser)
    parser.add_argument("--threads", type=int, default=1, help="OpenCV's threads (default %(default)s)")
    options = parser.parse_args()
    cv2.setNumThreads(options.threads)
    return service_server.run("human_detector", DetectPeople, SERVICE, DetectionService().answer, options)


if __name__ == "__main__":
    sys.exit(main())
