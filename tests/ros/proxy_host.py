"""A robot's sidecar without a network: offers one service in its domain; `python -m tests.ros.proxy_host NAME TYPE`."""

from __future__ import annotations

import logging
import signal
import sys
import threading

from plr.protos.model.ids import Role, ServiceName
from plr.sidecar.core.rules.service_rule import ServiceRule
from plr.sidecar.core.seam.application import OfferService
from plr.sidecar.ros.bridge import RosBridge
from tests.ros.loopback import Loopback
from tests.ros.mesh import wait_until


def main() -> None:
    ends = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: ends.set())
    name, kind = ServiceName(sys.argv[1]), sys.argv[2]
    robot = RosBridge(name="other-robot", role=Role.ROBOT, rules=(ServiceRule("/*", deadline_s=0.1, lifetime_s=1.0),))
    link = Loopback(robot, robot)
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    robot.start(link.robot)
    robot.handle(OfferService(name, kind))
    wait_until(lambda: name in link.carried, "the proxy")
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    ends.wait()
    robot.stop()
    link.stop()


if __name__ == "__main__":
    main()
