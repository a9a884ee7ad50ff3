"""Robot side: decides which copies of a request are sent, over which paths, and when.

The mapping names pairs of an interface and a server; the service's `RedundancyMode` says how many of them carry a copy
at once. Every copy sent while another one is awaited is an extra one, which the interface's budget has to allow.
"""

from __future__ import annotations

import enum
from typing import TYPE_CHECKING

from plr.sidecar.core.base.values import PathState
from plr.sidecar.core.robot.dispatch.adaptive import Adaptive
from plr.sidecar.core.robot.dispatch.budgets import Budgets
from plr.sidecar.core.robot.dispatch.exploration import Exploration
from plr.sidecar.core.robot.dispatch.favourites import Favourites
from plr.sidecar.core.robot.dispatch.modes import MODES
from plr.sidecar.core.robot.dispatch.pair_history import PathPaces, PathRecords
from plr.sidecar.core.robot.request.request import Copy, CopyState, Request
from plr.sidecar.core.seam.links import Seek
from plr.sidecar.core.wire.messages import RequestMessage, encode_message

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

    from plr.protos.model.ids import NodeName
    from plr.sidecar.core.base.values import PathId
    from plr.sidecar.core.robot.dispatch.context import RequestParts

SMALL_REQUEST_BYTES = 12_000
"""Requests of up to so many bytes (about ten datagrams) go over each mapped pair whole although their mode shares: they
hardly take capacity from others."""
MAX_COPIES_OF_REQUEST = 8
"""Most copies of one request, including those sent in trouble."""
MAX_COPIES_WHILE_REFUSED = 16
"""The same while it is certain that no server ran any of them, and each was given time to become ready."""


class _Why(enum.Enum):
    MAPPED = enum.auto()
    TROUBLE = enum.auto()
    HEDGE = enum.auto()
    EXPLORATION = enum.auto()


_PLANNED = frozenset((_Why.MAPPED, _Why.HEDGE))
"""Kinds of copies that may leave a request to each other, unless it is a full race, which measures each path alone. A
copy sent in trouble waits for no other, and nothing relies on a copy that explores."""


class Dispatching:
    """Sends copies."""

    def __init__(self, parts: RequestParts) -> None:
        self._parts = parts
        self._exploration = Exploration(parts.mapping, parts.routes, parts.outbox)
        self.records = PathRecords(parts.stats)
        self._paces = PathPaces(parts.routes, parts.stats)
        self.adaptive = Adaptive(parts.routes, self._paces)
        self._budgets = Budgets(parts.budgets, parts.stats)
        self._favourites = Favourites(parts.mapping, parts.routes)

    def with_room(self, servers: Iterable[NodeName], request: Request) -> list[NodeName]:
        """Return those of the servers to which the request may be sent now."""
        has_room = self._parts.outbox.has_room
        return [server for server in servers if has_room(server, request.size)]

    def candidates(self, request: Request, *, rejected: bool = False) -> tuple[NodeName, ...]:
        """Return the servers that may be sent a copy of a request, or a further one; `rejected` as in `rescue`."""
        servers = self._parts.offers.servers(request.service)
        if not request.copies:
            return servers
        if not request.rule.idempotent and not request.certainly_not_run():
            return ()
        return request.worth_another_copy(servers, rejected=rejected)

    def start(self, request: Request, servers: Collection[NodeName], now: float) -> float | None:
        """Send the first copies to some of these servers; return when to call `look_again`, if at all.

        Each of the servers has room for one copy.
        """
        rule = request.rule
        servers = self._favoured(servers, now)
        chosen = self._parts.mapping.choose(request.service, servers, idempotent=rule.idempotent)
        mode = MODES[rule.redundancy]
        if mode.shares and self._share(request, servers, chosen, now):
            pass
        elif mode.at_once:
            self._send_all(request, self._best_first(request, chosen, now) if self._budgets.limit else chosen, now)
        else:
            self._send_best(request, self._best_first(request, chosen, now), now)
        if servers and not request.copies:
            self._parts.command(Seek(frozenset(servers)))
        look_at = self.first_look(request, now)
        unmapped = self._exploration.path(request, servers, now) if rule.exploration else None
        if unmapped is not None and self._parts.outbox.admits(unmapped.peer, request.size):
            self._send(request, unmapped, now, _Why.EXPLORATION)
        request.choose_observation()
        return look_at

    def _favoured(self, servers: Collection[NodeName], now: float) -> Collection[NodeName]:
        """Return the servers within reach that are in favour; others only if there are none."""
        reached = [server for server in servers if self._parts.routes.reaches(server)]
        return self._parts.penalties.favoured(reached or servers, now)

    def _send_all(self, request: Request, paths: Iterable[PathId], now: float) -> None:
        served: set[NodeName] = set()
        withheld = []
        for path in paths:
            # The first copy may have taken the room that its server had.
            room = path.peer not in served or self._parts.outbox.admits(path.peer, request.size)
            if room and self._send(request, path, now, _Why.MAPPED):
                served.add(path.peer)
            else:
                withheld.append(path)
        request.withheld = tuple(withheld)

    def _send_best(self, request: Request, paths: list[PathId], now: float) -> None:
        while paths and not request.copies:
            self._send(request, paths.pop(0), now, _Why.MAPPED)
        request.withheld = tuple(paths)
        if request.copies:
            MODES[request.rule.redundancy].begun(self, request, now)

    def _share(self, request: Request, servers: Collection[NodeName], chosen: Collection[PathId], now: float) -> bool:
        """Send one copy to one of the servers over all interfaces of the chosen paths.

        Return False if none of them is up, or such a request is not to be shared.
        """
        if request.races or request.size <= SMALL_REQUEST_BYTES:
            return False
        server = self._favourites.choose(request.service, servers, chosen)
        if server is None:
            return False
        self._send_shared(request, server, chosen, _Why.MAPPED, now)
        request.withheld = tuple(path for path in chosen if path.peer != server)
        return True

    def _send_shared(
        self, request: Request, server: NodeName, paths: Collection[PathId], why: _Why, now: float
    ) -> bool:
        """Send one copy to a server over all interfaces of these paths, some of which reach it."""
        first, *others = self._parts.mapping.up_to(server, paths)
        size = request.size
        others = [path for path in others if self._budgets.allows(path.interface, request.service, size, now)]
        return self._send(request, first, now, why, shared_by=tuple(others), repeats=request.rule.repeats)

    def _best_first(self, request: Request, paths: Iterable[PathId], now: float) -> list[PathId]:
        """Sort paths: those that are up first, among them the best by the mode, then the fastest."""
        mode, routes = MODES[request.rule.redundancy], self._parts.routes

        def order(path: PathId) -> tuple[bool, float, float]:
            return routes.state(path) is not PathState.UP, mode.slowness(self, request, path, now), routes.rtt(path)

        return sorted(paths, key=order)

    def first_look(self, request: Request, now: float) -> float | None:
        """Return when to call `look_again` for a request of which one copy was just sent, if at all."""
        if now >= request.deadline_at or not request.relied_on():
            return None
        return MODES[request.rule.redundancy].first_look(self, request, now)

    def look_again(self, request: Request, now: float) -> float | None:
        """Look at a request at the moment named by `start` or the last call; return when to look once more."""
        if request.done or request.is_answered or not request.relied_on():
            return None
        return MODES[request.rule.redundancy].look_again(self, request, now)

    def replaces_lost(self, request: Request) -> bool:
        """Return whether a copy of it of which nothing is heard is to be replaced."""
        return MODES[request.rule.redundancy].replaces_lost

    def hedge(self, request: Request, path: PathId, now: float) -> bool:
        """Send a copy because another one is slow; return whether a budget allowed it."""
        return self._send(request, path, now, _Why.HEDGE)

    def ask_another_server(self, request: Request, now: float) -> None:
        """Ask another server, also over the same interface, if the only one asked has the request and is silent."""
        if request.rule.idempotent and request.waits_for_one_server():
            self.rescue(request, now, insist=True)

    def rescue(self, request: Request, now: float, *, insist: bool = False, rejected: bool = False) -> None:
        """Send one more copy when no copy that is relied on is on a path that is up (or when `insist`).

        A request that is not idempotent may go to another server only when it is certain that none has run it.
        """
        routes = self._parts.routes
        waiting = request.relied_on()
        if request.is_answered or (waiting and not request.rule.redundancy.helps):
            return
        if MODES[request.rule.redundancy].shares and len(request.asked()) == 1:
            arriving = [copy for copy in waiting if self._is_on_its_way(copy)]
            if arriving:  # over every interface already: another copy takes from it what it needs
                if insist:
                    self._try_another_server(request, arriving[0], now)
                return
        if rejected and len(request.copies) >= MAX_COPIES_OF_REQUEST:
            return  # its retry keeps asking, at a slower pace
        alive = any(routes.best_state(copy.paths) is not PathState.DOWN for copy in waiting)
        if alive and not insist and MODES[request.rule.redundancy].watches(self, request, now):
            return
        if not insist and any(routes.best_state(copy.paths) is PathState.UP for copy in waiting):
            return
        path = self.next_withheld(request, now) or self._elsewhere(request, now, rejected=rejected)
        if path is None:
            path = self._take_back(request, waiting, now)
        if path is None:
            return
        used = {each.interface for copy in waiting if self._is_on_its_way(copy) for each in copy.paths}
        if path.interface in used:
            return  # another copy behind it would only delay it
        self._send(request, path, now, _Why.TROUBLE)

    def _is_on_its_way(self, copy: Copy) -> bool:
        """Return whether its server may not have all of it yet because its path is slow but not silent."""
        return not copy.message.newest.is_there and self._is_reached(copy)

    def _is_reached(self, copy: Copy) -> bool:
        """Return whether a path that carries it is up."""
        return self._parts.routes.best_state(copy.paths) is PathState.UP

    def _try_another_server(self, request: Request, slow: Copy, now: float) -> None:
        """Share a request with another server as well, if it is time to find out whether one is better."""
        if not self._favourites.may_try(request.service, now):
            return
        servers = self.with_room(self._favoured(self.candidates(request), now), request)
        server = self._favourites.other(request.service, slow.path.peer, servers, slow.paths)
        if server is not None and self._send_shared(request, server, slow.paths, _Why.TROUBLE, now):
            self._favourites.tried(request.service, now)

    def next_over_another_interface(self, request: Request, now: float) -> PathId | None:
        """Return the same, if none of the copies relied on uses its interface."""
        used = {path.interface for copy in request.relied_on() for path in copy.paths}
        path = self.next_withheld(request, now)
        return None if path is None or path.interface in used else path

    def next_withheld(self, request: Request, now: float) -> PathId | None:
        """Return the best mapped path that is up and carries no copy, to a server that may run it."""
        waiting = {copy.path.peer for copy in request.relied_on()}
        refused = {copy.path.peer for copy in request.copies if copy.refused}
        for path in request.withheld:
            if self._parts.routes.state(path) is not PathState.UP or path.peer in refused:
                continue
            if self._parts.penalties.out_until(path.peer) > now:
                continue
            if not self._parts.outbox.has_room(path.peer, request.size):
                continue
            if request.rule.idempotent or path.peer in waiting:
                return path
        return None

    def _elsewhere(self, request: Request, now: float, *, rejected: bool) -> PathId | None:
        servers = self._favoured(self.candidates(request, rejected=rejected), now)
        return self._parts.mapping.rescue(self.with_room(servers, request))

    def _take_back(self, request: Request, waiting: list[Copy], now: float) -> PathId | None:
        """Take a request that is not idempotent back from a server that no path reaches, if nothing has left for it.

        Return the path it can take instead; without one it stays where it is.
        """
        routes, outbox = self._parts.routes, self._parts.outbox
        if request.rule.idempotent or not waiting or len(request.pending()) > len(waiting):
            return None
        if any(routes.reaches(copy.path.peer) or copy.message.may_have_left for copy in waiting):
            return None
        if not all(copy.certainly_not_run for copy in request.copies if copy.state is not CopyState.PENDING):
            return None  # an earlier copy may have run, and its server is gone
        servers = request.worth_another_copy(self._parts.offers.servers(request.service), rejected=False)
        path = self._parts.mapping.rescue(self.with_room(servers, request))
        if path is None:
            return None
        for copy in waiting:
            outbox.drop(copy.message)
        if any(copy.message.may_have_left for copy in waiting):
            return None  # its link was faster
        for copy in waiting:
            self.never_left(request, copy, now)
        return path

    def never_left(self, request: Request, copy: Copy, now: float) -> None:
        """End a copy of which nothing has left: it has not run, and tells nothing about its path or server."""
        copy.state, copy.ended_at, copy.certainly_not_run = CopyState.DEAD, now, True
        copy.message.newest.stand_down()
        if request.observed and not copy.hedges:
            self._parts.measurements.called_off(request.carried(copy), now - copy.sent_at)

    def answered(self, request: Request, copy: Copy, processing_s: float, now: float) -> None:
        """Note an answered copy. After its deadline it had to wait for fresher ones, so its pace means nothing."""
        latency_s = min(now - copy.sent_at, request.rule.deadline_s)
        if not copy.shared_by:
            self._paces.answered(request.service, copy.path, latency_s, processing_s, now)
        if MODES[request.rule.redundancy].shares and not request.races:
            self._favourites.answered(request.service, copy, request.relied_on(), request.rule.deadline_s, now)

    def ended(self, request: Request, now: float) -> None:
        """Note the outcome of the copies, once for each request: all are known, or the deadline is over."""
        self.records.note(request, now)
        if MODES[request.rule.redundancy].shares:
            self._judge_favourite(request, now)
        if self._budgets.limit and any(copy.in_time for copy in request.copies):
            paths = (*request.withheld, *(copy.path for copy in request.copies))
            self._budgets.earn(request.copies[0].message.symbols.total, {path.interface for path in paths})

    def _judge_favourite(self, request: Request, now: float) -> None:
        """Count a missed deadline of the only server asked, to which a path is up.

        If the request must not run twice, let the next ones go elsewhere in place of this one.
        """
        waiting = request.relied_on()
        if len(request.asked()) > 1 or not any(self._is_reached(copy) for copy in waiting):
            return
        service, paths = request.service, waiting[0].paths
        server = waiting[0].path.peer
        self._favourites.missed(service, server)
        if request.rule.idempotent or not self._favourites.may_try(service, now):
            return
        other = self._favourites.other(service, server, self._favoured(self._parts.offers.servers(service), now), paths)
        if other is not None:
            self._favourites.tried(service, now)
            self._favourites.move(service, other)

    def _send(
        self,
        request: Request,
        path: PathId,
        now: float,
        why: _Why,
        *,
        shared_by: tuple[PathId, ...] = (),
        repeats: float = 0.0,
    ) -> bool:
        """Send a copy for which the server has room; return whether the budgets and MAX_COPIES_OF_REQUEST allow it."""
        sent = len(request.copies)
        if request.payload is None or (sent >= MAX_COPIES_OF_REQUEST and sent >= _most_copies(request)):
            return False
        rule, stats = request.rule, self._parts.stats
        extra = bool(request.copies and request.relied_on())
        if extra and not self._budgets.allows(path.interface, request.service, request.size, now):
            return False
        deadline, expires = request.deadline_at, request.expires_at
        content = encode_message(
            RequestMessage(
                request.id,
                len(request.copies),
                rule.priority,
                deadline - now,
                expires - now,
                request.service,
                request.type,
                request.payload,
            )
        )
        message = self._parts.outbox.send(
            path,
            content,
            priority=rule.priority,
            fec=rule.fec,
            deadline=deadline,
            expires=expires,
            copy_of=request.id,
            siblings=request.messages if why in _PLANNED and not request.races else None,
            shared_by=shared_by,
            repeats=repeats,
        )
        explores = why is _Why.EXPLORATION
        copy = Copy(path, now, message, explores=explores, shared_by=shared_by, hedges=why is _Why.HEDGE)
        request.copies.append(copy)
        self._parts.in_flight.add_copy(request, copy)
        request.withheld = tuple(other for other in request.withheld if other != path)
        if extra:
            self._budgets.spend(path.interface, request.size)
        for other in shared_by:
            self._budgets.spend(other.interface, request.size)  # at most
        stats.copy_bytes[path.interface, request.service, "extra" if extra else "first"] += request.size
        if explores:
            stats.explored[path.interface, path.peer, request.service] += 1
        elif why is _Why.HEDGE:
            stats.hedged[path.interface, path.peer, request.service] += 1
        return True


def _most_copies(request: Request) -> int:
    patient = request.retry_at is None and request.certainly_not_run()
    return MAX_COPIES_WHILE_REFUSED if patient else MAX_COPIES_OF_REQUEST
