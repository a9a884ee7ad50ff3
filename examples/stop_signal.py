"""SIGINT and SIGTERM as a flag that a loop looks at.

Neither rclpy's own handling nor Python's KeyboardInterrupt ends a program the same way every time: about one SIGTERM in
a hundred comes at a moment in which rclpy's wait misses it, and an interrupt that strikes while rclpy's C++ code builds
a message comes out as a SystemError.
"""

from __future__ import annotations

import signal


class StopSignal:
    """Set by the first SIGINT or SIGTERM. Pass `SignalHandlerOptions.NO` to rclpy.init beside it."""

    def __init__(self) -> None:
        self.came = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._remember)

    def _remember(self, *_: object) -> None:
        self.came = True
