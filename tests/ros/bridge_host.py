"""A program with both bridges inside, for the tests of signals; run as `python -m tests.ros.bridge_host`."""

from __future__ import annotations

import queue
import signal
import sys
import threading

from plr.protos.model.ids import Role
from plr.sidecar.core.rules.service_rule import ServiceRule
from plr.sidecar.ros.bridge import RosBridge
from tests.ros.loopback import Loopback


def say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main() -> None:
    signals: queue.SimpleQueue[int] = queue.SimpleQueue()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda got, _frame: signals.put(got))
    rules = (ServiceRule("/*", deadline_s=0.1, lifetime_s=1.0),)
    robot = RosBridge(name="robot", role=Role.ROBOT, rules=rules)
    cloud = RosBridge(name="cloud", role=Role.CLOUD, rules=rules)
    link = Loopback(robot, cloud)
    robot.start(link.robot)
    cloud.start(link.cloud)
    say("ready")
    say(signal.Signals(signals.get()).name)
    stopped = robot.stop() and cloud.stop()
    link.stop()
    if stopped and threading.active_count() == 1:
        say("stopped")


if __name__ == "__main__":
    main()
