"""Runs a fleet's control streams in one event loop: each with its own certificate, TLS connection, and reports.

The dialogue is the sidecar's own (`ControlSession`: backoff, reports, heartbeats, acks). The rest of a robot, ROS and
the data plane, is left out.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections import Counter
from typing import TYPE_CHECKING

import grpc

from plr.protos.convert import control_message_from_proto, sidecar_message_to_proto
from plr.protos.model.ids import Role
from plr.protos.model.mapping import MappingSet
from plr.protos.plr.v1 import control_pb2_grpc
from plr.protos.trust.identity import CONTROL_PLANE_DNS
from plr.sidecar.control.channel import REFUSALS
from plr.sidecar.core.base.report_scope import ReportScope
from plr.sidecar.core.control.session import Apply, ControlState

if TYPE_CHECKING:
    from collections.abc import Iterable

    from bench.control.member import Member
    from plr.protos.model.ids import NodeName
    from plr.protos.model.members import PeerSet
    from plr.protos.plr.v1 import control_pb2
    from plr.sidecar.core.control.session import ControlSession

    Call = grpc.aio.StreamStreamCall[control_pb2.SidecarMessage, control_pb2.ControlMessage]

OPTIONS: tuple[tuple[str, int | str], ...] = (
    ("grpc.min_reconnect_backoff_ms", 60_000),
    ("grpc.enable_retries", 0),
    ("grpc.use_local_subchannel_pool", 1),
    ("grpc.ssl_target_name_override", CONTROL_PLANE_DNS),
)


class Crowd:
    """Members that keep themselves connected to the control plane at `target`."""

    def __init__(self, members: Iterable[Member], target: str, ca_pem: bytes) -> None:
        self.members = {member.name: member for member in members}
        self.ended: Counter[str] = Counter()
        """Ended streams by gRPC's code."""
        self.sets: Counter[str] = Counter()
        """Messages and bytes received."""
        self._target = target
        self._ca_pem = ca_pem
        self._wake = {name: asyncio.Event() for name in self.members}
        self._tasks: dict[NodeName, asyncio.Task[None]] = {}

    def start(self) -> None:
        """Connect all members, each when the sidecar's backoff lets it."""
        for member in self.members.values():
            self._tasks[member.name] = asyncio.create_task(self._keep_connected(member))

    async def leave(self, name: NodeName) -> None:
        """Break the stream of a member, as if its process were killed."""
        await self._cancel([self._tasks.pop(name)])

    async def close(self) -> None:
        """End all members."""
        await self._cancel(list(self._tasks.values()))
        self._tasks.clear()

    @staticmethod
    async def _cancel(tasks: list[asyncio.Task[None]]) -> None:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    def online(self) -> int:
        """Return how many members are registered."""
        return sum(member.session.state is ControlState.ONLINE for member in self.members.values())

    def unmapped(self) -> int:
        """Return how many robots have no mapping."""
        return sum(member.role is Role.ROBOT and not member.mapped for member in self.members.values())

    def lose_server(self, dead: NodeName) -> float:
        """Make every robot find at once that no path to this server is up; return when."""
        now = time.monotonic()
        for member in self.members.values():
            if member.role is Role.ROBOT:
                member.dead = dead
                member.session.report_at_once(now, ReportScope.CHANGES)
                self._wake[member.name].set()
        return now

    def hang_server(self, hung: NodeName) -> None:
        """Make a server accept requests but answer no robot any more."""
        for member in self.members.values():
            member.hung = hung

    def serve(self, name: NodeName, *, up: bool) -> None:
        """End a cloud's ROS node, or bring it back."""
        self.members[name].serve(up=up)
        self._wake[name].set()

    async def _keep_connected(self, member: Member) -> None:
        while True:
            delay_s = member.session.retry_at - time.monotonic()
            if delay_s > 0:
                await asyncio.sleep(delay_s)
            await self._one_stream(member)

    async def _one_stream(self, member: Member) -> None:
        credentials = grpc.ssl_channel_credentials(self._ca_pem, member.issued.key_pem, member.issued.certificate_pem)
        session = member.session
        session.opened(time.monotonic())
        refused = False
        channel = grpc.aio.secure_channel(self._target, credentials, options=OPTIONS)
        try:
            call = control_pb2_grpc.ControlPlaneStub(channel).Connect()
            tasks = [asyncio.create_task(self._write(member, call)), asyncio.create_task(self._give_up(session, call))]
            try:
                async for message in call:
                    self._take(member, message)
            finally:
                call.cancel()
                await self._cancel(tasks)
            self.ended["closed"] += 1
        except asyncio.CancelledError:
            # The call was cancelled, not this task.
            task = asyncio.current_task()
            if task is None or task.cancelling():
                raise
        except grpc.aio.AioRpcError as error:
            self.ended[f"{error.code().name}: {error.details()}"[:240]] += 1
            refused = error.code() in REFUSALS
        finally:
            # Its own close searches every task of the loop for calls of the channel: a minute for a thousand channels.
            channel._channel.close()  # type: ignore[attr-defined]
            session.closed(time.monotonic(), refused=refused)

    async def _give_up(self, session: ControlSession, call: Call) -> None:
        """Give up as the sidecar does; the first write waits for the connection, so the writer cannot do this."""
        await asyncio.sleep(max(session.next_timer() - time.monotonic(), 0.0))
        if session.welcome_overdue(time.monotonic()):
            self.ended["no welcome"] += 1
            call.cancel()

    async def _write(self, member: Member, call: Call) -> None:
        session, wake = member.session, self._wake[member.name]
        reported_at = time.monotonic()
        while True:
            wake.clear()
            now = time.monotonic()
            session.handle_timer(now)
            scope = session.report_due(now)
            if scope is ReportScope.CHANGES:
                session.send_report(member.path_changes(), now)
            elif scope is ReportScope.ALL:
                session.send_report(member.report(now - reported_at), now)
                reported_at = now
            try:
                for message in session.messages_to_send(now):
                    await call.write(sidecar_message_to_proto(message))
            except (grpc.aio.AioRpcError, asyncio.InvalidStateError):
                return
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(max(session.next_timer() - time.monotonic(), 0.0)):
                    await wake.wait()

    def _take(self, member: Member, message: control_pb2.ControlMessage) -> None:
        self.sets[str(message.WhichOneof("kind"))] += 1
        self.sets["bytes"] += message.ByteSize()
        now = time.monotonic()
        event = member.session.receive(control_message_from_proto(message), now)
        if isinstance(event, Apply):
            self._apply(member, event.content, now)
            member.session.applied(event, None)
        self._wake[member.name].set()

    @staticmethod
    def _apply(member: Member, content: PeerSet | MappingSet, now: float) -> None:
        if isinstance(content, MappingSet):
            for service in content.services:
                member.mapped = frozenset(one.server for one in service.assignments)
                member.mapped_at = now
