"""A subscriber of the sidecar's notices, in a ROS context of its own."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node

if TYPE_CHECKING:
    from types import TracebackType


class NoticeListener:
    """Collects what is published on the two topics while its `with` block lasts."""

    def __init__(self, domain: int) -> None:
        self.deadlines: list[Any] = []
        self.failures: list[Any] = []
        self._context = Context()
        rclpy.init(args=[], context=self._context, domain_id=domain)
        self._node = Node("notice_listener", context=self._context)
        self._subscriptions = [
            self._node.create_subscription(DiagnosticArray, "/plr/deadline_missed", self.deadlines.append, 10),
            self._node.create_subscription(DiagnosticArray, "/plr/request_failed", self.failures.append, 10),
        ]
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._spin)

    def is_matched(self) -> bool:
        """True once the sidecar's publishers are known here."""
        return all(self._node.count_publishers(subscription.topic_name) for subscription in self._subscriptions)

    def __enter__(self) -> NoticeListener:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._context.shutdown()
        self._thread.join()
        self._node.destroy_node()

    def _spin(self) -> None:
        try:
            self._executor.spin()
        except ExternalShutdownException:
            pass
