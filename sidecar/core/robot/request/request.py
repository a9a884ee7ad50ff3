"""Robot side: holds one request in flight and its copies."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

from plr.sidecar.core.base.request_id import is_race

if TYPE_CHECKING:
    from plr.protos.model.ids import InterfaceName, NodeName, ServiceName
    from plr.sidecar.core.base.values import PathId, RequestId
    from plr.sidecar.core.message.outbound import OutboundMessage
    from plr.sidecar.core.message.symbols import MessageSymbols
    from plr.sidecar.core.rules.service_rule import ServiceRule

HEDGE_AT = 0.5
"""Share of the deadline after which another server is worth asking if the only one with the request is silent."""


class Carried(NamedTuple):
    """Copies that are measured together."""

    interface: InterfaceName
    server: NodeName
    service: ServiceName
    size_class: int


class Answer(NamedTuple):
    """What is known about a copy's answer besides its content."""

    size: int
    processing_s: float
    at: float
    measured: bool
    """Whether it counts as a measurement of its path."""


class CopyState(enum.Enum):
    """What became of a copy."""

    PENDING = "pending"
    ANSWERED = "answered"
    REJECTED = "rejected"
    """It was refused, or its answer cannot be delivered."""
    DEAD = "dead"
    """Its server's session ended, or it was called off or taken back."""


@dataclass(slots=True)
class Copy:
    """One sending of a request to one server."""

    path: PathId
    sent_at: float
    message: OutboundMessage
    state: CopyState = CopyState.PENDING
    certainly_not_run: bool = False
    """It was refused without being run, or nothing of it left before it was dead."""
    in_time: bool = False
    """It was answered before the deadline."""
    session_over: bool = False
    """Its server's session has ended: a server that comes back under that name does not know the copy."""
    answer: Answer | None = None
    """The answer that the application is judging."""
    ended_at: float | None = None
    """When it was answered or called off."""
    explores: bool = False
    """It was sent to explore a path that is not used otherwise: nothing relies on it."""
    shared_by: tuple[PathId, ...] = ()
    """Further paths that carry it. It shows none of them alone, and is not measured."""
    hedges: bool = False
    """It was sent because another one took long. It shows its path at such a moment only, and is not measured."""
    forecast_s: float | None = None
    """How long its answer was expected to take when it was sent."""
    arrived: int = 0
    """Number of its symbols known to have arrived when it was last looked at ..."""
    progress_at: float = field(init=False)
    """... and when that number was first seen."""

    def __post_init__(self) -> None:
        self.progress_at = self.sent_at

    @property
    def paths(self) -> tuple[PathId, ...]:
        """All paths that carry it."""
        return (self.path, *self.shared_by)

    @property
    def refused(self) -> bool:
        """Return whether its server would refuse it again."""
        return self.state is CopyState.REJECTED and not self.session_over


@dataclass(slots=True)
class Request:
    """A request until all its copies are settled."""

    id: RequestId
    service: ServiceName
    type: str
    rule: ServiceRule
    payload: bytes | None
    submitted_at: float
    size_class: int = 0
    """Size class, fixed when it was submitted (`plr.protos.base.size_class`)."""
    size: int = 0
    """Bytes of a copy's message, fixed when it was submitted."""
    held: int = field(init=False)
    """Bytes of its payload, which stay in memory until its last copy has ended."""
    deadline_at: float = field(init=False)
    expires_at: float = field(init=False)
    races: bool = field(init=False)
    """All its copies are to be measured: it is a full race if it has several."""
    copies: list[Copy] = field(default_factory=list)
    messages: list[MessageSymbols] = field(default_factory=list)
    """Messages of the copies that may leave the request to each other: siblings."""
    withheld: tuple[PathId, ...] = ()
    """Further paths that its mapping names, the best first: for trouble, or to explore."""
    slept_before_s: float = 0.0
    """How long the host had been suspended in all when it was submitted."""
    dark: tuple[InterfaceName, ...] = ()
    """Interfaces over which no path to any of its servers was up when it was submitted."""
    observed: bool = True
    """All its copies are measured, and none is called off before the deadline."""
    done: bool = False
    """The application got its response, or the request failed."""
    missed: bool = False
    answered_locally: bool = False
    """The application got its answer on the robot. No more copies are sent; those under way are awaited until the
    deadline for what they tell about their paths."""
    judged: int = 0
    """Number of answers that the application is judging."""
    found_unreachable: bool = False
    retry_at: float | None = None
    """When servers that refused it for the moment are asked again (s); None: never."""
    refusal: str = ""
    """Why the last of them refused it."""
    outcomes_measured: bool = False
    """The copies that missed the deadline have been counted."""

    def __post_init__(self) -> None:
        self.held = len(self.payload or b"")
        self.deadline_at = self.submitted_at + self.rule.deadline_s
        self.expires_at = self.submitted_at + self.rule.lifetime_s
        self.races = is_race(self.id)

    @property
    def is_answered(self) -> bool:
        """Return whether the application has an answer or is judging one: meanwhile no copy is sent."""
        return self.answered_locally or self.judged > 0

    def pending(self) -> list[Copy]:
        return [copy for copy in self.copies if copy.state is CopyState.PENDING]

    def relied_on(self) -> list[Copy]:
        """Return the pending copies except those that explore."""
        return [copy for copy in self.pending() if not copy.explores]

    def asked(self) -> set[NodeName]:
        """Return the servers of all copies except those that explore."""
        return {copy.path.peer for copy in self.copies if not copy.explores}

    def carried(self, copy: Copy) -> Carried:
        """Return the group in which the copy is measured."""
        return Carried(copy.path.interface, copy.path.peer, self.service, self.size_class)

    def waits_for_one_server(self) -> bool:
        """Return whether a single server was asked, holds the request, and has not answered."""
        return len(self.asked()) == 1 and any(copy.message.newest.is_there for copy in self.relied_on())

    def certainly_not_run(self) -> bool:
        """Return whether no server has run it or will run it."""
        return all(copy.certainly_not_run for copy in self.copies)

    def may_be_sent(self) -> bool:
        """Return whether no copy of it may be answered any more, and another one does no harm."""
        return not (self.done or self.judged or self.pending()) and (self.rule.idempotent or self.certainly_not_run())

    def worth_another_copy(self, servers: tuple[NodeName, ...], *, rejected: bool) -> tuple[NodeName, ...]:
        """Return those of `servers` that have no pending copy and refused none.

        If there are none and this is not about a refusal (`rejected`), return those that could not run it (starting,
        draining, full) and may be able to now.
        """
        busy = {copy.path.peer for copy in self.relied_on()}
        refused = {copy.path.peer for copy in self.copies if copy.refused}
        asked = busy | refused
        others = tuple(server for server in servers if server not in asked)
        if others or rejected:
            return others
        hopeless = {copy.path.peer for copy in self.copies if not copy.certainly_not_run}
        return tuple(server for server in servers if server in refused - hopeless)

    def choose_observation(self) -> None:
        """Decide, when the first copies go out, whether this request is a full race.

        A single copy has nothing to lose against, unless it may be hedged. One that several paths carry measures none.
        """
        alone = len(self.copies) < 2 and not any(copy.shared_by for copy in self.copies)
        self.observed = self.races or (alone and not self.rule.redundancy.sends_late)

    def started_together(self) -> list[Copy]:
        """Return the copies sent when the request came, or when there was a path at last."""
        return [copy for copy in self.copies if copy.sent_at == self.copies[0].sent_at and not copy.hedges]
