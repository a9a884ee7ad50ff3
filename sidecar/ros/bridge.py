"""Bridges the local ROS graph and the data plane.

One thread, `plr-ros`, owns all ROS entities. It waits for requests and answers, takes, serialises and passes them on,
and it deserialises and sends what the data plane hands over. `handle` only queues an event and wakes that thread.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from typing import TYPE_CHECKING, Protocol

from plr.protos.model.ids import Role
from plr.sidecar.core.base.values import RejectReason
from plr.sidecar.core.seam.application import ExecuteRequest
from plr.sidecar.ros import shared_memory, static_peers
from plr.sidecar.ros.cloud.cloud_side import CloudSide
from plr.sidecar.ros.errors import RosStartError
from plr.sidecar.ros.event_queue import EventQueue
from plr.sidecar.ros.graph.graph import sidecar_node_name
from plr.sidecar.ros.graph.scans import Scans
from plr.sidecar.ros.log_limit import LimitedLog
from plr.sidecar.ros.robot.robot_side import RobotSide
from plr.sidecar.ros.ros_loop import RosLoop
from plr.sidecar.ros.stats import BridgeStats

if TYPE_CHECKING:
    from collections.abc import Iterator

    from plr.sidecar.core.rules.service_rule import ServiceRule
    from plr.sidecar.core.seam.application import ApplicationEvent
    from plr.sidecar.ports import Application, DataPlane
    from plr.sidecar.ros.ros_loop import Waited

DRAIN_S = 0.005
"""Time the ROS thread spends on the data plane's events before it takes the servers' answers again."""
STOP_TIMEOUT_S = 5.0
"""Destroying some hundred DDS endpoints takes less than a second."""
START_AGAIN_S = 5.0
"""How often ROS is started again while it does not start, for example because of a wrong clock."""
_ERROR_PAUSE_S = 0.1
"""Pause after the wait itself failed, so that a broken rmw does not burn a core."""

log = logging.getLogger(__name__)


class _Side(Protocol):
    """What RobotSide and CloudSide have in common."""

    scan_is_due: bool

    def settling(self) -> bool: ...
    def handle(self, event: ApplicationEvent, now: float) -> None: ...
    def take(self, entity: Waited, now: float) -> None: ...
    def scan(self) -> Iterator[None]: ...
    def next_due(self) -> float | None: ...
    def on_timer(self, now: float) -> None: ...
    def close(self) -> None: ...


class RosBridge:
    """The application side of a sidecar: proxies services on a robot, runs requests in the cloud."""

    def __init__(self, *, name: str, role: Role, rules: tuple[ServiceRule, ...], domain_id: int | None = None) -> None:
        """Take the sidecar's `name`; with `domain_id` None, ROS_DOMAIN_ID counts, as for every node."""
        self.name = name
        self.role = role
        self.stats = BridgeStats()
        self._rules = rules
        self._domain_id = domain_id
        self._events = EventQueue()
        self._stopping = False
        self._stop_asked = threading.Event()
        self._loop: RosLoop | None = None
        self._thread: threading.Thread | None = None
        self._limited = LimitedLog(log)

    @property
    def alive(self) -> bool:
        """True while the ROS thread runs."""
        return self._thread is not None and self._thread.is_alive()

    def start(self, data_plane: DataPlane) -> None:
        """Join the ROS domain and start the ROS thread, which tries again if ROS does not start now."""
        if self._thread is not None:
            raise RuntimeError("the bridge has already been started")
        self._leave_out_peers()
        joined = self._join(data_plane)
        self._thread = threading.Thread(target=self._run, args=(data_plane, joined), name="plr-ros", daemon=True)
        self._thread.start()

    def stop(self, timeout: float = STOP_TIMEOUT_S) -> bool:
        """Withdraw everything and leave the domain; return True if that took at most `timeout` seconds."""
        self._stopping = True
        self._stop_asked.set()
        if self._loop is not None:
            self._loop.wake()
        if self._thread is None:
            return True
        self._thread.join(timeout)
        if self._thread.is_alive():
            log.error("the ROS thread did not end within %.1f s", timeout)
            return False
        return True

    def handle(self, event: ApplicationEvent) -> None:
        """Queue an event for the ROS thread; any thread may call this, and it never blocks."""
        self._events.put(event)
        loop = self._loop
        if loop is not None and not self._stopping:
            loop.wake()

    def _leave_out_peers(self) -> None:
        self.stats.left_out_peers = static_peers.unresolvable(os.environ)
        if self.stats.left_out_peers:
            log.warning("%s", static_peers.told(self.stats.left_out_peers))
            os.environ.update(static_peers.without(os.environ, self.stats.left_out_peers))

    def _join(self, data_plane: DataPlane) -> tuple[RosLoop, _Side] | None:
        """Join the ROS domain; return None if ROS does not start now, which is logged once."""
        try:
            loop = RosLoop(sidecar_node_name(self.name), self._domain_id)
        except RosStartError as error:
            if self.stats.not_started != str(error):
                log.error("%s (tried again every %g s; until then no service is carried)", error, START_AGAIN_S)
            self.stats.not_started = str(error)
            return None
        try:
            side = self._make_side(loop, data_plane)
        except BaseException:
            loop.close()
            raise
        self.stats.not_started = ""
        self._loop = loop
        log.info("joined ROS domain %d as %s", loop.domain_id, loop.node.get_fully_qualified_name())
        apart = shared_memory.problem(os.environ, os.geteuid(), shared_memory.users_of_domain(os.environ))
        if apart is not None:
            log.warning("%s; do: %s", apart, shared_memory.REMEDY)
        return loop, side

    # -- the ROS thread --------------------------------------------------------------------------------------------

    def _make_side(self, loop: RosLoop, data_plane: DataPlane) -> _Side:
        if self.role is Role.ROBOT:
            return RobotSide(
                loop=loop,
                name=self.name,
                rules=self._rules,
                data_plane=data_plane,
                stats=self.stats,
                limited_log=self._limited,
                now=time.monotonic(),
            )
        return CloudSide(
            loop=loop, rules=self._rules, data_plane=data_plane, stats=self.stats, limited_log=self._limited
        )

    def _run(self, data_plane: DataPlane, joined: tuple[RosLoop, _Side] | None) -> None:
        while joined is None:
            if self._stop_asked.wait(START_AGAIN_S):
                self._refuse_queued(data_plane)
                return
            joined = self._join(data_plane)
        loop, side = joined
        scans = Scans(side.scan, side.settling, time.monotonic())
        while not self._stopping:
            try:
                now = time.monotonic()
                if loop.graph_changed or side.scan_is_due:
                    loop.graph_changed = side.scan_is_due = False
                    scans.changed(now)
                scans.turn(now)
                scan_at, due = scans.next_due(), side.next_due()
                until = scan_at if due is None else min(scan_at, due)
                ready = loop.wait(0.0 if self._events else until - time.monotonic())
            # Retry a wait or scan that failed; requests at the servers and answers stay as they are.
            except Exception:
                self._note_error("wait", time.monotonic())
                time.sleep(_ERROR_PAUSE_S)
                continue
            now = time.monotonic()
            for entity in ready:  # before the events, which may destroy some of them
                try:
                    side.take(entity, now)
                except Exception:
                    self._note_error("take", now)
            self._drain(side, now)
            try:
                side.on_timer(now)
            except Exception:
                self._note_error("timer", now)
        try:
            self._refuse_queued(data_plane)
            side.close()
        finally:
            loop.close()

    def _drain(self, side: _Side, now: float) -> None:
        """Hand over the data plane's events, for DRAIN_S at most."""
        ends = now + DRAIN_S
        while (event := self._events.take()) is not None:
            try:
                side.handle(event, now)
            # A failing event must not stop the others.
            except Exception:
                self._note_error("event", now)
            now = time.monotonic()
            if now >= ends:
                return

    def _refuse_queued(self, data_plane: DataPlane) -> None:
        while (event := self._events.take()) is not None:
            if isinstance(event, ExecuteRequest):
                self.stats.refused[event.service, "draining"] += 1
                data_plane.refuse(event.execution, RejectReason.DRAINING, "the sidecar is shutting down")

    def _note_error(self, where: str, now: float) -> None:
        self.stats.errors[where] += 1
        self._limited.log(logging.ERROR, ("error", where), now, "error in the ROS thread (%s)", where, exc_info=True)


def _assert_protocol(bridge: RosBridge) -> Application:
    """Let the type checker compare RosBridge with the seam."""
    return bridge
