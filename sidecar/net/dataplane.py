"""Runs the data plane for the rest of the sidecar: the engine behind one lock, a thread for each interface.

Locking (docs/develop/adr/0004-threads-and-one-lock.md): an interface's thread builds, parses and sends its datagrams
without any lock; the engine's lock is held only while tables are read and written. There is no coordinator thread: a
thread that has news for the engine (a link's, a ROS thread) takes the lock, tells it, and queues the results.
"""

from __future__ import annotations

import logging
import threading
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from plr.sidecar.core.base.values import PathState
from plr.sidecar.core.engine.engine import Engine, EngineConfig
from plr.sidecar.core.link.pinging import Pong
from plr.sidecar.core.seam.links import CheckPaths, Ping, ResetPaths, SendClose, SetCredential
from plr.sidecar.net.decoder import Decoder
from plr.sidecar.net.engine_turn import EngineTurn
from plr.sidecar.net.peer_trust import PeerTrust
from plr.sidecar.net.timerfd import Timer
from plr.sidecar.net.watchdog import LOOK_EVERY_S, Watchdog

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from plr.protos.model.ids import InterfaceName, NodeName, ServiceName, SessionId
    from plr.protos.model.mapping import MappingSet, ServiceMapping
    from plr.protos.model.members import PeerSet, ServiceOffer, ServiceUse
    from plr.protos.model.report import Report
    from plr.protos.trust.credential import SessionCredential
    from plr.sidecar.core.base.report_scope import ReportScope
    from plr.sidecar.core.base.values import ExecutionId, PathId, RejectReason, RequestId
    from plr.sidecar.core.crypto.session import OwnSession
    from plr.sidecar.core.engine.engine import RemovedCounts, RemovedPeerView
    from plr.sidecar.core.message.decoding import Decoding
    from plr.sidecar.core.path.history import LivenessChange
    from plr.sidecar.core.path.view import PathView
    from plr.sidecar.core.robot.robot_role import Destinations
    from plr.sidecar.core.seam.application import CarriedService
    from plr.sidecar.core.seam.links import LinkEvent
    from plr.sidecar.core.seam.stats import EngineStats, LinkStats
    from plr.sidecar.net.interface_thread import InterfaceThread
    from plr.sidecar.ports import Application

log = logging.getLogger(__name__)

EVENTS_A_TURN = 32
"""Events of a link that are taken without releasing the lock: a path that goes down hands back thousands."""
YIELD_S = 100e-6
"""Pause between two turns of one thread, for threads that wait for the lock: it goes to the first that asks, and a
thread that must be woken for it is too late."""
STOP_S = 2.0
"""Time for each of our threads to end."""
ERROR_PAUSE_S = 0.1
"""Pause after an internal error, which may recur at every turn."""


@dataclass(frozen=True, slots=True)
class DataPlaneHooks:
    """Callbacks of the data plane."""

    application: Application
    services_changed: Callable[[], None]
    """`services` may have changed, which the control plane has to know; called with the engine's lock held."""
    reach_changed: Callable[[], None]
    """Interfaces or peers may have come: a mapping that was refused for lack of them may fit now."""
    paths_changed: Callable[[Mapping[InterfaceName, PathState]], None]
    """Takes the best state of the paths over each interface that has some; called with the engine's lock held."""
    revocations: Callable[[NodeName, bytes], None]
    """Takes a peer's revocation lists (PEM), which nobody has judged; called with the engine's lock held."""
    report_urgent: Callable[[ReportScope], None] = lambda scope: None
    """Something happened that should be reported at once; called with the engine's lock held."""
    pong: Callable[[Pong], None] = lambda _: None
    """Takes the result of a ping; called on an interface's thread, which must not wait there."""


class ThreadedDataPlane:
    """Implements `DataPlane` and `ControlledDataPlane` (`plr.sidecar.ports`), `LinkOwner` and `DecodingOwner`.

    Every method may be called from any thread.
    """

    def __init__(self, config: EngineConfig, own: OwnSession, hooks: DataPlaneHooks) -> None:
        self._own = own
        self._hooks = hooks
        self._clock = time.monotonic
        self._engine = Engine(config, own, self._clock())
        self._lock = threading.RLock()  # the application may call us from its `handle`
        self._turn = EngineTurn(self._engine, self._lock, self._clock, self._queue_outputs)
        self.peer_trust = PeerTrust(own, self._engine, self._lock, self._turn, hooks.reach_changed)
        self._links: dict[InterfaceName, InterfaceThread] = {}
        self._timer = Timer()
        self._decoder = Decoder(self)
        self._watchdog = Watchdog(self._clock())
        self._told_paths = self._engine.routes.best
        self._stopping = False
        self._timer_thread = threading.Thread(target=self._run_timer, name="plr-timer", daemon=True)

    # -- life -----------------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Start the timer and the decoder; interfaces come through `set_links`."""
        self._timer_thread.start()
        self._decoder.start()

    def set_links(self, links: dict[InterfaceName, InterfaceThread]) -> None:
        """Use these interfaces from now on; the caller starts and stops their threads."""
        with self._turn as (_, now):
            self._links = dict(links)
            self._use_links_that_run(now)
            self._post_credential()  # it may have been renewed since they were made
        self._hooks.reach_changed()

    def _post_credential(self) -> None:
        credential = self._own.credential.encode()
        for link in self._links.values():
            link.post(SetCredential(credential))

    def drain(self) -> None:
        """Take no new requests."""
        with self._lock:
            self._engine.drain()

    @property
    def busy(self) -> int:
        """Return the number of requests and messages in flight that somebody still waits for."""
        with self._lock:
            return self._engine.busy

    def stop(self) -> None:
        """Say goodbye to the peers, end the timer and the decoder; the caller stops the links afterwards."""
        with self._lock:
            links = list(self._links.values())
        for link in links:
            link.post(SendClose())
            link.wake()
        self._stopping = True
        with self._lock:
            self._timer.arm(0.0)
        self._timer_thread.join(STOP_S)
        self._decoder.stop(STOP_S)

    # -- plr.sidecar.ports.DataPlane ----------------------------------------------------------------------------------

    @property
    def session(self) -> SessionId:
        """Return this run's session."""
        return self._own.credential.session

    def submit(self, request_id: RequestId, service: ServiceName, payload: bytes) -> None:
        """Robot: send a serialised request."""
        with self._turn as (engine, now):
            engine.robot.requests.submit(request_id, service, payload, now)

    def judge_answer(self, request_id: RequestId, copy: int, problem: str | None) -> None:
        """Robot: note that this copy's answer was delivered to the application, or cannot be because of `problem`."""
        with self._turn as (engine, now):
            engine.robot.requests.judge_answer(request_id, copy, problem, now)

    def answered_locally(self, request_id: RequestId) -> None:
        """Robot: note that the application got its answer on the robot."""
        with self._turn as (engine, now):
            engine.robot.requests.answered_locally(request_id, now)

    def complete(self, execution: ExecutionId, payload: bytes, processing_s: float) -> None:
        """Cloud: send the local server's answer."""
        with self._turn as (engine, now):
            engine.cloud.complete(execution, payload, processing_s, now)

    def refuse(self, execution: ExecutionId, reason: RejectReason, detail: str) -> None:
        """Cloud: refuse a request that was not or will not be answered."""
        with self._turn as (engine, now):
            engine.cloud.refuse(execution, reason, detail, now)

    def set_offers(self, offers: tuple[ServiceOffer, ...]) -> None:
        """Cloud: replace the services that local servers offer right now."""
        with self._turn as (engine, _):
            engine.cloud.set_offers(offers)

    def set_carried(self, services: frozenset[CarriedService]) -> None:
        """Robot: replace the proxied services that exist right now."""
        with self._turn as (engine, _):
            engine.robot.set_carried(services)

    # -- the control client ---------------------------------------------------------------------------------------

    def services(self) -> tuple[tuple[ServiceOffer, ...], tuple[ServiceUse, ...]]:
        """Return the services that are offered and those that are carried right now."""
        with self._lock:
            return self._engine.offers(), self._engine.uses()

    def services_of_peers(self) -> set[ServiceName]:
        """Return the services that the peers offer, whatever their names."""
        with self._lock:
            return self._engine.services_of_peers()

    def unreached_services(self) -> dict[ServiceName, int]:
        """Return the services for which no offering peer is reached, each with the number of those peers."""
        with self._lock:
            return self._engine.robot.catalog.unreached

    def apply_peers(self, peer_set: PeerSet) -> str | None:
        """Take a view of the peers; return why it is refused, or None."""
        self.peer_trust.judge(peer_set.peers)
        with self._turn as (engine, now):
            error = engine.apply_peers(peer_set, now)
        self.peer_trust.log_news()
        if error is None:
            self._hooks.reach_changed()
        return error

    def renew_credential(self, credential: SessionCredential) -> None:
        """Use this session's credential, signed with our renewed certificate.

        Raises:
            ValueError: it belongs to another session.
        """
        with self._lock:
            self._own.renew(credential)
            self._post_credential()

    def apply_mapping(self, mapping: MappingSet) -> str | None:
        """Take a mapping; return why it is refused, or None."""
        with self._lock:
            return self._engine.apply_mapping(mapping)

    def take_report(self, scope: ReportScope) -> Report:
        """Return what was measured since the last call."""
        with self._lock:
            return self._engine.take_report(self._clock(), scope)

    def check_paths(self, interface: InterfaceName) -> None:
        """Find out whether anything is answered over this interface, as the control stream is not."""
        link = self._links.get(interface)
        if link is not None:
            link.post(CheckPaths())
            link.wake()

    # -- what people ask of one node ------------------------------------------------------------------------------

    def ping(self, path: PathId, number: int, size: int) -> None:
        """Send a ping of `size` bytes over this path; `DataPlaneHooks.pong` gets the result, if there is one."""
        link = self._links.get(path.interface)
        if link is None:
            self._hooks.pong(Pong(number, path, problem="there is no such interface"))
            return
        link.post(Ping(path, number, size))
        link.wake()

    def paths_to(self, peer: str) -> list[PathId]:
        """Return the links' paths to a peer, whatever their state; takes no lock."""
        return [path for link in list(self._links.values()) for path in link.link.paths_to(peer)]

    def path_views(self, now: float) -> Iterator[tuple[PathView, LivenessChange | None]]:
        """Yield each path's state and its last change; takes no lock, and may be paused between two."""
        for link in list(self._links.values()):
            for view in link.link.views(now):
                yield view, link.history.last(view.id)

    def gone_paths(self, since: float, at_most: int) -> list[tuple[PathId, LivenessChange]]:
        """Return the paths that ended after `since` because their peers are gone, the latest first; takes no lock."""
        gone: list[tuple[PathId, LivenessChange]] = []
        for link in list(self._links.values()):
            known = link.link.path_ids()
            gone += [(path, last) for path, last in link.history.all().items() if path not in known]
        gone = [(path, last) for path, last in gone if last.state is PathState.DOWN and last.at > since]
        return sorted(gone, key=lambda one: -one[1].at)[:at_most]

    def removed_peers(self, since: float, at_most: int) -> list[RemovedPeerView]:
        """Return the peers that the control plane removed after `since` (monotonic, s), and those that are kept."""
        with self._lock:
            return self._engine.removed_peers(since, at_most)

    def removed_counts(self, since: float) -> RemovedCounts:
        """Return how many peers the control plane removed after `since` (monotonic, s), and how many are kept."""
        with self._lock:
            return self._engine.removed_counts(since)

    def heard_dormant(self, now: float) -> set[NodeName]:
        """Return the dormant peers that are heard, but do not hear what this sidecar answers; takes no lock."""
        return {name for link in list(self._links.values()) for name in link.link.heard_dormant(now)}

    def destinations(self) -> Destinations:
        """Robot: return where new requests may go; the engine's lock is held to copy references only."""
        with self._lock:
            return self._engine.robot.destinations(self._clock())

    # -- what metrics and status read -----------------------------------------------------------------------------

    @property
    def engine_stats(self) -> EngineStats:
        """Return the requests' counters."""
        return self._engine.stats

    def link_stats(self) -> list[LinkStats]:
        """Return the interfaces' counters."""
        return [link.link.stats for link in list(self._links.values())]

    @property
    def service_mappings(self) -> tuple[ServiceMapping, ...]:
        """Return the mapping in force."""
        with self._lock:
            return self._engine.service_mappings

    # -- LinkOwner ------------------------------------------------------------------------------------------------

    def on_link_events(self, events: list[LinkEvent]) -> None:
        """Take a link's events."""
        for first in range(0, len(events), EVENTS_A_TURN):
            if first:
                time.sleep(YIELD_S)
            with self._turn as (engine, now):
                for event in events[first : first + EVENTS_A_TURN]:
                    engine.on_link_event(event, now)
                to_decode = engine.decodings
            if to_decode:
                self._decoder.wake()

    def on_pong(self, pong: Pong) -> None:
        """Take the result of a ping."""
        self._hooks.pong(pong)

    # -- DecodingOwner --------------------------------------------------------------------------------------------

    def next_decoding(self) -> Decoding | None:
        """Return the message whose next slice is to be computed."""
        with self._lock:
            return self._engine.next_decoding()

    def on_decoded(self, decoding: Decoding) -> None:
        """Take a message whose decoding is complete."""
        with self._turn as (engine, now):
            engine.on_decoded(decoding, now)

    def on_decoding_failed(self, decoding: Decoding) -> None:
        """Give up a message that cannot be decoded."""
        with self._lock:
            self._engine.on_decoding_failed(decoding)

    # -- under the lock -------------------------------------------------------------------------------------------

    def _queue_outputs(self) -> set[InterfaceThread]:
        """Queue commands to links and events to the application, in order; return the links to wake."""
        woken: set[InterfaceThread] = set()
        for interface, command in self._engine.take_commands():
            for link in self._links_for(interface):
                link.post(command)
                woken.add(link)
        for event in self._engine.take_events():
            self._hooks.application.handle(event)
        for peer, pem in self._engine.revocations.take_arrived():
            self._hooks.revocations(peer, pem)
        if self._engine.take_services_changed():
            self._hooks.services_changed()
        urgent = self._engine.take_urgency()
        if urgent is not None:
            self._hooks.report_urgent(urgent)
        best = self._engine.routes.best
        if best is not self._told_paths:
            self._told_paths = best
            self._hooks.paths_changed(best)
        # Set the kernel's timer, do not wake its thread: nearly every request is answered long before its deadline.
        self._timer.arm_at_latest(self._engine.next_timer())
        return woken

    def _use_links_that_run(self, now: float) -> None:
        running = [name for name, link in self._links.items() if not self._watchdog.hangs(link)]
        self._engine.set_interfaces(running, now)

    def _look_for_hung_links(self, now: float) -> bool:
        """Return whether the interfaces in use have changed."""
        changes = self._watchdog.look(self._links.values(), now)
        if changes is None:
            return False
        for link in changes.hung:
            log.warning("%s: its driver does not return; requests take other paths", link.interface)
            link.link.stats.hangs += 1
        for link in changes.back:
            log.warning("%s: its driver is back", link.interface)
            # Its view of its paths is as old as what it still has to send.
            link.post(ResetPaths("driver hung"))
        self._use_links_that_run(now)
        return True

    def _links_for(self, interface: InterfaceName | None) -> list[InterfaceThread]:
        if interface is None:
            return list(self._links.values())
        link = self._links.get(interface)
        return [] if link is None else [link]

    # -- the timer's thread ---------------------------------------------------------------------------------------

    def _run_timer(self) -> None:
        while not self._stopping:
            try:
                self._timer_turn()
            except Exception:
                # Without this thread no deadline would be noticed and no request would end.
                log.exception("internal error; the timers continue")
                time.sleep(ERROR_PAUSE_S)
            else:
                if self._timer.due <= self._clock():
                    time.sleep(YIELD_S)
                self._timer.wait()

    def _timer_turn(self) -> None:
        with self._turn as (engine, now):
            changed = self._look_for_hung_links(now)
            engine.handle_timer(now)
            if not self._stopping:
                # Before the outputs: what the application answers at once may have an earlier deadline.
                self._timer.arm(min(engine.next_timer(), now + LOOK_EVERY_S))
        if changed:
            self._hooks.reach_changed()
