"""Publishes a robot's missed deadlines and failed requests as messages on ROS topics.

`diagnostic_msgs/DiagnosticArray` ships with every ROS base installation, and has a time stamp, key-value pairs and
tools that show it. A custom type would have to be built on each robot, and `rcl_interfaces/Log` has only a text.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy

if TYPE_CHECKING:
    from plr.sidecar.core.seam.application import DeadlineMissed, RequestFailed

DEADLINE_TOPIC = "/plr/deadline_missed"
FAILURE_TOPIC = "/plr/request_failed"
_TOPIC_DEPTH = 100
"""Notices kept for a subscriber that is briefly slow."""


class NoticePublisher:
    """Publishes one message for each missed deadline and each failed request."""

    def __init__(self, node: Any, sidecar: str) -> None:
        self._node = node
        self._sidecar = sidecar
        qos = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=_TOPIC_DEPTH, reliability=ReliabilityPolicy.RELIABLE)
        self._deadline = node.create_publisher(DiagnosticArray, DEADLINE_TOPIC, qos)
        self._failure = node.create_publisher(DiagnosticArray, FAILURE_TOPIC, qos)

    def deadline_missed(self, event: DeadlineMissed) -> None:
        """Publish that a deadline passed without a response."""
        if not self._deadline.get_subscription_count():
            return
        values = [
            KeyValue(key="request_id", value=event.request_id.hex()),
            KeyValue(key="deadline_s", value=f"{event.deadline_s:g}"),
        ]
        values += [
            KeyValue(key=f"copy_{number}", value=f"{copy.interface} -> {copy.server}")
            for number, copy in enumerate(event.copies)
        ]
        text = f"no response within the deadline of {event.deadline_s * 1000:g} ms"
        self._publish(self._deadline, DiagnosticStatus.WARN, event.service, text, values)

    def request_failed(self, event: RequestFailed) -> None:
        """Publish that a request will not be answered."""
        if not self._failure.get_subscription_count():
            return
        values = [
            KeyValue(key="request_id", value=event.request_id.hex()),
            KeyValue(key="outcome", value=event.outcome),
            KeyValue(key="elapsed_s", value=f"{event.elapsed_s:.6f}"),
        ]
        self._publish(self._failure, DiagnosticStatus.ERROR, event.service, event.reason, values)

    def _publish(self, publisher: Any, level: bytes, service: str, text: str, values: list[Any]) -> None:
        status = DiagnosticStatus(level=level, name=service, message=text, hardware_id=self._sidecar, values=values)
        message = DiagnosticArray(status=[status])
        message.header.stamp = self._node.get_clock().now().to_msg()
        publisher.publish(message)
