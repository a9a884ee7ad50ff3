"""Runs one interface's share of the data plane: its datagrams and all its paths. Owned by one thread; sans-IO.

The driver feeds `receive_batch`, `execute` and `handle_timer`, then drains `next_event` and `batches_to_send`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from plr.sidecar.core.base.timers import NEVER, Timers
from plr.sidecar.core.base.values import PathId, PathState
from plr.sidecar.core.link.liveness import PathKeeper
from plr.sidecar.core.link.memory import LinkMemory
from plr.sidecar.core.link.mtu import LinkMtu
from plr.sidecar.core.link.path_table import PathTable
from plr.sidecar.core.link.receiver import LinkReader
from plr.sidecar.core.link.sender import Batch, Burst, DatagramBuilder
from plr.sidecar.core.path.congestion.choice import DEFAULT_CONTROLLER
from plr.sidecar.core.path.key_exchange import DEFAULT_LIMITS, KeyLimits
from plr.sidecar.core.path.view import view_of
from plr.sidecar.core.seam.links import (
    Attend,
    CheckPaths,
    FinishedLost,
    FragmentsLost,
    LinkCommand,
    LinkEvent,
    PathChanged,
    PathMtuChanged,
    Ping,
    Rebind,
    Resend,
    ResetPaths,
    Seek,
    Send,
    SendAbandon,
    SendClose,
    SendFinished,
    SendForgotten,
    SetCarrier,
    SetCredential,
    SetMtu,
    SetPeers,
    SetReady,
)
from plr.sidecar.core.seam.stats import PathStats
from plr.sidecar.core.wire import frame

if TYPE_CHECKING:
    import random
    from collections import deque
    from collections.abc import Callable, Iterable, Iterator, Mapping

    from plr.protos.model.ids import Address, NodeName
    from plr.sidecar.core.link.pinging import Pong
    from plr.sidecar.core.link.sender import LinkIdentity
    from plr.sidecar.core.message.symbols import MessageSymbols
    from plr.sidecar.core.path.path import Path
    from plr.sidecar.core.path.view import PathView
    from plr.sidecar.core.seam.links import LinkPeer

MAX_FINISHED_DELAY_S = 0.003
"""How long FINISHED of a small request, and the acknowledgement with it, waits for the answer. It is less than
MAX_ACK_DELAY_S, so that a busy host's delay does not look like a loss to the sender."""
MEASURE_EVERY_S = 0.25
"""Interval at which a path's round-trip times go to the engine."""


class Link:
    """All paths over one interface."""

    def __init__(
        self,
        identity: LinkIdentity,
        rng: random.Random,
        now: float,
        memory: LinkMemory | None = None,
        limits: KeyLimits = DEFAULT_LIMITS,
        controller: str = DEFAULT_CONTROLLER,
    ) -> None:
        """Create the link; `memory` is what this interface's previous link, in the same session, left by `remember`.

        `controller` names the congestion controller of its paths (`path/congestion/choice.py`).
        """
        self.identity = identity
        table = self._table = PathTable(identity, LinkMemory() if memory is None else memory, limits, controller, rng)
        self.stats = table.stats
        self._builder = DatagramBuilder(identity, table.stats)
        self._mtu = LinkMtu(table.events)
        self._keeper = PathKeeper(table, self._mtu)
        self._reader = LinkReader(table, self._keeper, self._mtu)
        self._paths = table.paths
        self._dirty = table.dirty
        self._events = table.events
        self._ready = False
        self._carrier = True
        self._timers: Timers[PathId] = Timers()
        self._unarmed: dict[PathId, Path] = {}
        """Paths that have sent since their timer was set. Setting it waits until timers are asked for; datagrams do not
        wait."""
        self._stirred: dict[PathId, Path] = {}
        """Paths that may have something to report: a link with thousands of idle ones looks at these alone."""
        self._measure_at = now + MEASURE_EVERY_S

    # -- what the driver calls ------------------------------------------------------------------------------------

    def receive_batch(self, data: memoryview, segment: int, source: Address, now: float) -> None:
        """Take contiguous datagrams from `source`, of `segment` bytes each; the last may be shorter.

        Fragments in the events view `data`: it must stay valid until the engine has had all events.
        """
        self._reader.receive_batch(data, segment, source, now)

    def execute(self, command: LinkCommand, now: float) -> None:
        """Carry out a command of the engine."""
        match command:
            case Send(path_id, message):
                path = self._live_path(path_id, message, range(len(message)) if message.sharing is None else ())
                if path is not None:
                    path.queue.add(message)
            case Resend(path_id, message, indices):
                path = self._live_path(path_id, message, indices)
                if path is not None:
                    path.queue.resend(message, indices)
            case SendFinished(path_id, number, at_once):
                path = self._paths.get((path_id.peer, path_id.remote))
                if path is None or path.state is PathState.DOWN:
                    self._events.append(PathChanged(path_id, PathState.DOWN, "not usable here"))
                    self._events.append(FinishedLost(path_id, (number,)))
                else:
                    by = now if at_once else now + MAX_FINISHED_DELAY_S
                    self._table.owe_finished(path, number, by)
            case SendAbandon(path_id, number):
                path = self._paths.get((path_id.peer, path_id.remote))
                if path is not None and path.state is not PathState.DOWN:
                    self._table.owe(path, frame.encode_abandon(frame.Abandon(number)))
            case SendForgotten(path_id, number):
                path = self._paths.get((path_id.peer, path_id.remote))
                if path is not None:
                    self._table.owe(path, frame.encode_forgotten(frame.Forgotten(number)))
            case SetPeers(peers, removed):
                self._set_peers(peers, removed, now)
            case SetCredential(credential):
                self._renew(credential, now)
            case SetReady(ready):
                self._ready = ready
                self._probe_what_is_down(now)
            case SetCarrier(on, why_not):
                self._carrier = on
                if not on:
                    self._keeper.take_all_down(why_not)
                self._probe_what_is_down(now)
            case ResetPaths(reason):
                self._keeper.take_all_down(reason)
                self._probe_what_is_down(now)
            case Seek(peers):
                for path in self._paths_to(peers):
                    if path.state is PathState.DOWN:
                        path.hasten_probe(now)
                        self._dirty[path.id] = path
            case CheckPaths():
                for path in self._paths.values():
                    if path.state is PathState.UP:
                        path.hasten_probe(now)
                        self._dirty[path.id] = path
            case Attend(peers):
                for path in self._paths_to(peers):
                    path.needed(now)
                    self._dirty[path.id] = path
            case Ping():
                path = self._paths.get((command.path.peer, command.path.remote)) if self._may_probe else None
                if self._table.pings.ask(path, command, now) and path is not None:
                    self._dirty[path.id] = path
            case SetMtu(mtu):
                self._mtu.set_interface(mtu, self._paths.values(), now)
                self._dirty.update((path.id, path) for path in self._paths.values())
            case Rebind(lost, rerouted):
                for path in self._paths.values():
                    if path.state is PathState.DOWN or path.leaves_from(lost) or path.family in rerouted:
                        self._keeper.rebind(path, now)
            case SendClose():
                self._table.closing = True
                for path in self._paths.values():
                    if path.state is not PathState.DOWN:
                        self._table.owe(path, frame.encode_close())

    def handle_timer(self, now: float) -> None:
        """Do what is due by now."""
        self._rearm()
        while (path_id := self._timers.pop_due(now)) is not None:
            path = self._paths.get((path_id.peer, path_id.remote))
            if path is not None:  # an introduction may have replaced this path
                self._dirty[path_id] = path
                self._keeper.on_timer(path, now)
        if self._stirred and now >= self._measure_at:
            self._measure_at = now + MEASURE_EVERY_S
            self._measure(now)

    def next_timer(self) -> float:
        """Return when `handle_timer` is wanted next."""
        self._rearm()
        timer = self._timers.next()
        return min(NEVER if timer is None else timer, self._measure_at if self._stirred else NEVER)

    def on_too_big(self, destination: Address, size: int, now: float) -> None:
        """Note that the kernel refused to send a datagram of this many bytes over the interface (EMSGSIZE)."""
        for path in self._paths.values():
            if path.remote == destination:
                self._mtu.too_big(path, size, now)
                self._dirty[path.id] = path

    def next_event(self) -> LinkEvent | None:
        """Return the oldest event not taken yet."""
        return self._events.popleft() if self._events else None

    @property
    def pongs(self) -> deque[Pong]:
        """Results of pings, the oldest first; the driver takes them out."""
        return self._table.pings.done

    def path_ids(self) -> set[PathId]:
        """Return the ids of all paths, except those to dormant peers that are down; any thread may ask."""
        return {path.id for path in list(self._paths.values()) if not path.is_dormant}

    def paths_to(self, peer: str) -> list[PathId]:
        """Return the paths to a peer; any thread may ask."""
        return [path.id for (name, _), path in self._paths.copy().items() if name == peer]

    def views(self, now: float) -> Iterator[PathView]:
        """Yield the current view of each path, except those to dormant peers that are down.

        Any thread may ask: it reads what this link's thread writes.

        Each view costs that thread nothing but its turn of the interpreter; a caller with many may pause between them.
        """
        for path in list(self._paths.values()):
            if not path.is_dormant:
                yield view_of(path, now)

    def heard_dormant(self, now: float) -> set[NodeName]:
        """Return the dormant peers that introduce themselves again and again; any thread may ask.

        Each introduction is answered, so they do not hear the answers.
        """
        paths = list(self._paths.values())
        return {path.peer for path in paths if path.is_dormant and path.introductions.introducer(now)}

    def living(self) -> list[PathId]:
        """Return the paths that are not down."""
        return [path.id for path in self._paths.values() if path.state is not PathState.DOWN]

    def note_source(self, path_id: PathId, source_towards: Callable[[Address], str | None]) -> None:
        """Note the local address from which the kernel sends to the path's remote one, as `source_towards` says."""
        path = self._paths.get((path_id.peer, path_id.remote))
        if path is not None and path.remote is not None:
            path.note_source(source_towards(path.remote))

    def in_use(self, address: Address) -> bool:
        """Return whether a path that is not down leads to this address."""
        return any(path.remote == address and path.state is not PathState.DOWN for path in self._paths.values())

    def batches_to_send(self, now: float) -> list[Batch]:
        """Build what may leave now, at most about BURST_DATAGRAMS; call again until it returns nothing."""
        if not self._dirty:
            return []
        burst = Burst()
        probing = self._may_probe
        for path in list(self._dirty.values()):
            if self._builder.build(path, burst, now, probing=probing):
                del self._dirty[path.id]
                self._unarmed[path.id] = path
                if not self._stirred:
                    self._measure_at = now + MEASURE_EVERY_S
                self._stirred[path.id] = path
            if burst.full:
                break
        return burst.batches

    # -- what paths may do ----------------------------------------------------------------------------------------

    @property
    def _may_probe(self) -> bool:
        return self._ready and self._carrier and not self._table.closing

    def _probe_what_is_down(self, now: float) -> None:
        self._table.way_changed(now)
        for path in self._paths.values():
            if path.state is PathState.DOWN:
                path.probing.begin_again(now)
            self._dirty[path.id] = path

    def _paths_to(self, peers: Iterable[NodeName]) -> list[Path]:
        return [path for peer in peers for path in self._table.to(peer)]

    def _live_path(self, path_id: PathId, message: MessageSymbols, indices: Iterable[int]) -> Path | None:
        """Return the path if it can carry the message; otherwise hand the symbols back as lost.

        What several paths carry together is lost only if none of them can: the engine looks. It may have an old state
        of the path, and is told again, so that it does not send them here once more.
        """
        path = self._paths.get((path_id.peer, path_id.remote))
        if path is None or path.state is PathState.DOWN:
            self._events.append(PathChanged(path_id, PathState.DOWN, "not usable here"))
            self._events.append(FragmentsLost(path_id, message, tuple(indices)))
            return None
        if message.datagram_bytes > path.mtu.size:
            self._events.append(PathMtuChanged(path_id, path.mtu.size))
            self._events.append(FragmentsLost(path_id, message, tuple(indices)))
            return None
        self._dirty[path.id] = path
        return path

    # -- measurements ---------------------------------------------------------------------------------------------

    def _measure(self, now: float) -> None:
        stirred, self._stirred = self._stirred, {}
        for path in stirred.values():
            self._keeper.report_measured(path)
            recovery = path.recovery
            path.recent_loss.note(recovery.total_sent, recovery.total_lost - recovery.reordering.spurious, now)
            recovery.reordering.forget_old(now)
            if recovery.reordering.remembers:
                self._stirred[path.id] = path
        for peer in {path.peer for path in stirred.values()}:
            self._publish_stats_of(peer)

    def _publish_stats_of(self, peer: NodeName) -> None:
        paths = [path for path in self._table.to(peer) if not path.is_dormant]
        if not paths:
            self.stats.paths.pop(peer, None)
            return
        path = next((path for path in paths if path.state is PathState.UP), paths[0])
        self.stats.paths[peer] = PathStats(
            up=path.state is PathState.UP,
            srtt_s=path.recovery.rtt.smoothed,
            datagrams_sent=path.recovery.total_sent,
            datagrams_lost=path.recovery.total_lost,
            spurious_losses=path.recovery.reordering.spurious,
            bytes_sent=path.bytes_sent,
            max_datagram=path.mtu.size,
            key_phase=path.sealing.phase,
        )

    def remember(self, *, hangs: bool = False) -> LinkMemory:
        """End the link; return what the interface's next one must know. `hangs`: its driver may not have ended."""
        return self._table.remember(hangs=hangs)

    # -- peers ----------------------------------------------------------------------------------------------------

    def _renew(self, credential: bytes, now: float) -> None:
        """Introduce ourselves with this credential, to established peers too: the one they hold may end first."""
        if credential == self._builder.identity.credential:
            return
        self._builder.identity = replace(self.identity, credential=credential)
        for path in self._paths.values():
            path.renew(now)

    def _set_peers(self, peers: tuple[LinkPeer, ...], removed: Mapping[NodeName, str], now: float) -> None:
        for path in self._table.set_peers(peers, now):
            if path.state is not PathState.DOWN:
                self._keeper.take_down(path, removed.get(path.peer, "peer left or restarted"))
            if (path.peer, path.remote_id) not in self._paths:
                self._dirty.pop(path.id, None)
                self._unarmed.pop(path.id, None)
                self._stirred.pop(path.id, None)
                self._timers.arm(path.id, None)
                self._publish_stats_of(path.peer)
        for peer in peers:
            if peer.dormant:
                self._publish_stats_of(peer.name)

    # -- timers ---------------------------------------------------------------------------------------------------

    def _rearm(self) -> None:
        for path in self._dirty.values():
            self._arm(path)
        for path in self._unarmed.values():
            self._arm(path)
        self._unarmed.clear()

    def _arm(self, path: Path) -> None:
        recovery = path.recovery
        timers = (
            path.probe_at if self._may_probe else None,
            path.mtu_probe_at if self._may_probe else None,
            path.gives_up_address_at,
            path.control_at,
            recovery.loss_timer if recovery.loss_timer is not None else recovery.pto_timer,
            path.silence_timer,
            path.next_release if len(path.queue) and not path.address.is_blocked else None,
        )
        due = min(timer for timer in timers if timer is not None)
        self._timers.arm(path.id, due if due < NEVER else None)
