"""Decides which role may call what on the gRPC port, and how often; nothing else reaches a service."""

from __future__ import annotations

import asyncio
import contextlib
import inspect
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import grpc

from plr.controlplane.core.base.member_table import MemberTable
from plr.protos.program.certificate_term import with_remedy
from plr.protos.trust.identity import WRONG_ROLE, IdentityRole

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable

    from plr.controlplane.serve.tls_gate import Caller

    _Handler = grpc.RpcMethodHandler[Any, Any]

_ANYBODY = frozenset(IdentityRole)

_ALLOWED = {
    "plr.v1.ControlPlane": frozenset({IdentityRole.ROBOT, IdentityRole.CLOUD}),
    "plr.v1.Admin": frozenset({IdentityRole.OPERATOR}),
    "grpc.reflection.v1alpha.ServerReflection": frozenset({IdentityRole.OPERATOR}),
    "grpc.health.v1.Health": _ANYBODY,
}
"""Service -> roles; a service that is missing here may be called by nobody."""


TOO_MANY_CALLS = "too_many_calls"

CALLS_PER_S = 20.0
"""Calls of one name, whatever they call: a sidecar makes one when it connects, an operator a few at a time."""

CALLS_BURST = 100.0
"""Calls of one name that are answered at once."""

LONGEST_WAIT_S = 10.0
"""A call that would have to wait for longer is refused, after this time."""

FIRST_WORDS_S = 2.0
"""Longest wait for the first message of a call that is refused: it follows the call's headers at once."""


async def first_words(context: Any) -> None:
    """Wait for the first message of a call that sends a stream, before the call is refused.

    A client that still writes when the refusal arrives may see INTERNAL: its failed write hides the status of the
    refusal (gRPC for Python, `grpc.aio`). A client that says nothing is refused after FIRST_WORDS_S.
    """
    with contextlib.suppress(TimeoutError, grpc.aio.BaseError):
        async with asyncio.timeout(FIRST_WORDS_S):
            await context.read()


@dataclass(slots=True)
class _Turns:
    """When one name's calls have their turns (the generic cell rate algorithm, ITU-T I.371)."""

    next_at: float


class CallRates:
    """Gives each name's calls their turns. Times are monotonic seconds."""

    def __init__(self) -> None:
        self._turns = MemberTable(_Turns)

    def take_turn(self, name: str, now: float) -> float | None:
        """Return for how long (s) this call has to wait; None if that is too long, and the call is to be refused."""
        turns = self._turns.of(name, now)
        next_at = max(turns.next_at, now)
        wait_s = max(0.0, next_at - now - (CALLS_BURST - 1.0) / CALLS_PER_S)
        if wait_s > LONGEST_WAIT_S:
            return None
        turns.next_at = next_at + 1.0 / CALLS_PER_S
        return wait_s


class AccessGuard(grpc.aio.ServerInterceptor):
    """Asks `caller` who is behind the peer of each call; passes the reason of each refusal to `on_refused`."""

    def __init__(self, caller: Callable[[str], Caller | None], on_refused: Callable[[str], None]) -> None:
        self._caller = caller
        self._on_refused = on_refused
        self._rates = CallRates()

    async def intercept_service(
        self,
        continuation: Callable[[grpc.HandlerCallDetails], Awaitable[_Handler | None]],
        handler_call_details: grpc.HandlerCallDetails,
    ) -> _Handler | None:
        """Wrap the method so that it runs only for the roles that may call it."""
        handler = await continuation(handler_call_details)
        if handler is None:
            return handler
        service = str(handler_call_details.method).rpartition("/")[0].removeprefix("/")
        sends_stream = bool(handler.request_streaming)
        return _wrap(handler, lambda context: self._admit(service, context, sends_stream=sends_stream))

    async def _admit(self, service: str, context: Any, *, sends_stream: bool) -> None:
        """Abort the call (which raises) unless its caller may make it."""
        caller = self._caller(context.peer())
        if caller is None:
            await context.abort(grpc.StatusCode.UNAUTHENTICATED, "the connection has ended")
        elif caller.refusal is not None:
            if sends_stream:
                await first_words(context)
            text = with_remedy(caller.refusal, caller.identity.name)
            await context.abort(grpc.StatusCode.UNAUTHENTICATED, text)
        elif caller.identity.role not in _ALLOWED.get(service, frozenset()):
            self._on_refused(WRONG_ROLE)
            if sends_stream:
                await first_words(context)
            name, role = caller.identity.name, caller.identity.role.value
            await context.abort(
                grpc.StatusCode.PERMISSION_DENIED,
                f"the certificate of {name} has the role {role}, which may not use {service}",
            )
        else:
            await self._wait_for_turn(caller.identity.name, context)

    async def _wait_for_turn(self, name: str, context: Any) -> None:
        """Hold back a call of a name that calls too often, even if it is to be refused.

        A held call costs next to nothing. Who is refused at once calls again at once.
        """
        wait_s = self._rates.take_turn(name, time.monotonic())
        if wait_s is None:
            self._on_refused(TOO_MANY_CALLS)
            await asyncio.sleep(LONGEST_WAIT_S)
            text = f"{name} makes more than {CALLS_PER_S:g} calls a second: call less often"
            await context.abort(grpc.StatusCode.RESOURCE_EXHAUSTED, text)
        elif wait_s:
            await asyncio.sleep(wait_s)


def _wrap(handler: _Handler, admit: Callable[[Any], Awaitable[None]]) -> _Handler:
    for kind in ("unary_unary", "unary_stream", "stream_unary", "stream_stream"):
        method = getattr(handler, kind)
        if method is not None:
            make = getattr(grpc, f"{kind}_rpc_method_handler")
            wrapped: _Handler = make(_guarded(method, admit), handler.request_deserializer, handler.response_serializer)
            return wrapped
    raise TypeError("a handler of no known kind")


def _guarded(method: Any, admit: Callable[[Any], Awaitable[None]]) -> Any:
    if inspect.isasyncgenfunction(method):

        async def generator(request: Any, context: Any) -> AsyncIterator[Any]:
            await admit(context)
            async for answer in method(request, context):
                yield answer

        return generator

    async def coroutine(request: Any, context: Any) -> Any:
        await admit(context)
        return await method(request, context)

    return coroutine
