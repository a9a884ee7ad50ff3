"""A server that answers every GetPlan request twice: what a robot must notice."""

from __future__ import annotations

from typing import Any

import rclpy
from nav_msgs.srv import GetPlan
from rclpy.executors import ExternalShutdownException

from examples.motion_planning.server import SERVICE, PlanService
from examples.motion_planning.warehouse import generate


def main() -> None:
    planner = PlanService(generate(7))

    def answer(request: Any, response: Any) -> Any:
        planner.answer(request, response)
        return response

    rclpy.init()
    node = rclpy.create_node("double_server")
    service = node.create_service(GetPlan, SERVICE, answer)
    send_once = service.send_response

    def send_twice(response: Any, header: Any) -> None:
        send_once(response, header)
        send_once(response, header)

    service.send_response = send_twice
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass


if __name__ == "__main__":
    main()
