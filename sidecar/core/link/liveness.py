"""Detects loss and judges liveness on one link's paths; lost symbols go back to the engine, which knows other paths."""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.sidecar.core.base.values import PathState
from plr.sidecar.core.seam.links import FinishedLost, FragmentsLost, PathChanged, PeerLied
from plr.sidecar.core.wire.frame import KEY_ANSWER_TYPE, encode_key_answer

if TYPE_CHECKING:
    from plr.protos.model.ids import Address
    from plr.sidecar.core.link.mtu import LinkMtu
    from plr.sidecar.core.link.path_table import PathTable
    from plr.sidecar.core.message.symbols import MessageSymbols
    from plr.sidecar.core.path.in_flight import Sent
    from plr.sidecar.core.path.path import Path
    from plr.sidecar.core.wire import frame


class PathKeeper:
    """Follows the paths of one link from up to down and back."""

    __slots__ = ("_events", "_mtu", "_table")

    def __init__(self, table: PathTable, mtu: LinkMtu) -> None:
        self._table = table
        self._mtu = mtu
        self._events = table.events

    def report_measured(self, path: Path) -> None:
        """Report to the engine what was measured since the last report."""
        measured = path.take_measured()
        if measured is not None:
            self._events.append(measured)

    def on_ack(self, path: Path, ack: frame.AckFrame, now: float) -> None:
        """Process an acknowledgement that came over the path."""
        recovery = path.recovery
        newly = recovery.on_ack(ack, now)
        if newly is None:
            self._table.stats.dropped["acks_the_unsent"] += 1
            self._events.append(PeerLied(path.peer, path.session))
            return
        # A datagram declared lost too early proves life as well as any other: where round trips grow faster than the
        # timeouts, all of them are such. Each datagram counts once: a repeated acknowledgement proves nothing.
        if late := recovery.late(ack, now):
            path.control.on_spurious(sum(run.size for run in late))
        arrived = newly + late
        if not arrived:
            return
        for run in arrived:
            if run.message is not None:
                run.message.acked[run.symbol : run.symbol + run.datagrams] = b"\1" * run.datagrams
        path.mtu.on_delivered(max(run.longest for run in arrived))
        if recovery.sample is not None:
            path.control.on_acked(recovery.sample, recovery.rtt, now)
        path.note_rtt()
        if path.made_progress(now):
            self.path_up(path, now)
        self._detect_lost(path, now)

    def probe_answered(self, path: Path, sent_at: float, now: float) -> None:
        """Note that a probe of liveness that left at `sent_at` (s) was answered."""
        path.mtu.on_delivered(0)
        in_flight = path.recovery.sent
        if path.made_progress(now):
            if in_flight and in_flight[0].at <= sent_at:
                # What left before the probe may be lost, and fill a window in which nothing else may leave.
                path.recovery.ask_at_once(now)
            self.path_up(path, now)

    def keys_offered(self, path: Path, offer: frame.KeyOffer, now: float) -> None:
        """Answer the offer of new keys from the peer, which leads. Raises DecodeError."""
        answer = path.answer_keys(offer, now)
        if answer is not None:
            # The same offer may have come twice by now, and a datagram holds one answer.
            path.owed.withdraw(KEY_ANSWER_TYPE)
            self._table.owe(path, encode_key_answer(answer))

    def keys_answered(self, path: Path, answer: frame.KeyAnswer, now: float) -> None:
        """Take the peer's answer to our offer of new keys. Raises DecodeError."""
        if path.take_keys(answer, now):
            self._answers(path, now)

    def follow_keys(self, path: Path, now: float) -> None:
        """Switch to the new keys if a datagram just opened with them."""
        if path.keys.follow(now):
            self._answers(path, now)

    def _answers(self, path: Path, now: float) -> None:
        if path.made_progress(now):
            self.path_up(path, now)

    def path_up(self, path: Path, now: float) -> None:
        """Note that the path answers and is up."""
        path.control.on_path_up(now)
        self.report_measured(path)  # before its first request, so that its round-trip time counts in the choice
        self._events.append(PathChanged(path.id, PathState.UP, "answers"))
        self._mtu.search(path, now)

    def on_timer(self, path: Path, now: float) -> None:
        """Find what is lost by now, and whether the path was silent for too long."""
        recovery = path.recovery
        if recovery.loss_timer is not None and recovery.loss_timer <= now:
            self._detect_lost(path, now)
        elif recovery.pto_timer is not None and recovery.pto_timer <= now:
            path.control.on_probe_timeout(now)
            self._lost(path, recovery.on_probe_timeout(now), now, timed_out=True)
        gives_up_at = path.gives_up_address_at
        if gives_up_at is not None and gives_up_at <= now:
            self._lead_back(path, now)
        if path.state is not PathState.DOWN and not path.keys.are_fresh:
            self.take_down(path, "keys worn out")
            return
        state = path.check_silence(now)
        if state is not None:
            if state is PathState.DOWN:
                self._hand_back(path, "silent", forget=False)
            else:
                self._events.append(PathChanged(path.id, state, "silent"))

    def follow(self, path: Path, source: Address, now: float) -> None:
        """Lead the path to where its peer's datagrams come from now."""
        if path.move(source, now):
            self._mtu.route_changed(path, now)

    def _lead_back(self, path: Path, now: float) -> None:
        """Return to the last proven address: nobody answers at the newest datagrams' source."""
        before = path.address.before()
        if before is not None:
            self._table.stats.dropped["address_unproven"] += 1
            self.follow(path, before, now)
            path.hasten_probe(now)
            self._table.dirty[path.id] = path

    def _detect_lost(self, path: Path, now: float) -> None:
        recovery = path.recovery
        lost = recovery.detect_lost(now)
        if lost:
            size = sum(run.size for run in lost)
            path.control.on_lost(size, lost[-1].at, recovery.in_flight, now)
            self._lost(path, lost, now)

    def take_all_down(self, reason: str) -> None:
        """Do as `take_down` for every path."""
        for path in self._table.paths.values():
            if path.state is not PathState.DOWN:
                self.take_down(path, reason)

    def take_down(self, path: Path, reason: str) -> None:
        """Take down a path known to be useless; answers to what it was asked before prove nothing, whenever they come.

        That is so for an interface without carrier, a driver that hangs, or a peer that says goodbye: what they left in
        a buffer must not bring the path back. A path that is down because of silence comes back by any answer (see
        `on_timer`): on a slow path a late answer is the only possible sign of life. An answer opens with this session's
        keys, is taken once by its packet number, and fits one question of the last LONGEST_ANSWER_S. So someone who can
        hold datagrams back, but not forge them, can make a dead path seem alive for that long at most.
        """
        path.probing.forget()
        path.go_down()
        self._hand_back(path, reason, forget=True)

    def _hand_back(self, path: Path, reason: str, *, forget: bool) -> None:
        """Report the path down, and hand back what it still carried."""
        path.control.on_path_down()
        self._events.append(PathChanged(path.id, PathState.DOWN, reason))
        self._report_lost(path, path.recovery.give_up_all(forget=forget))
        unsent = path.owed.take_finished()
        if unsent:
            self._events.append(FinishedLost(path.id, unsent))
        for message, indices in path.queue.clear():
            self._events.append(FragmentsLost(path.id, message, indices))

    def rebind(self, path: Path, now: float) -> None:
        """Send what is in flight again elsewhere: it left from an address we lost, or its answers go there."""
        was_up = path.state is PathState.UP
        self._mtu.start_afresh(path)
        path.start_afresh(now)
        self._table.dirty[path.id] = path
        if was_up:
            self._events.append(PathChanged(path.id, path.state, "rebinding"))
        self._report_lost(path, path.recovery.give_up_all(forget=True), timed_out=True)

    def _lost(self, path: Path, lost: list[Sent], now: float, *, timed_out: bool = False) -> None:
        self._mtu.lost(path, lost, now)
        self._report_lost(path, lost, timed_out=timed_out)

    def _report_lost(self, path: Path, lost: list[Sent], *, timed_out: bool = False) -> None:
        by_message: dict[int, tuple[MessageSymbols, list[int]]] = {}
        finished: list[int] = []
        for run in lost:
            if run.message is not None:
                missing = filter(run.message.needs, run.indices)
                by_message.setdefault(run.message.number, (run.message, []))[1].extend(missing)
            if path.state is PathState.DOWN:
                finished += run.finished
            else:
                for number in run.finished:
                    self._table.owe_finished(path, number)
        if finished:
            self._events.append(FinishedLost(path.id, tuple(finished)))
        for message, indices in by_message.values():
            if indices:
                self._events.append(FragmentsLost(path.id, message, tuple(indices), timed_out))
