"""Decides which role may call what on the gRPC port, and refuses everything else before any service sees it."""

from __future__ import annotations

import inspect
from typing import TYPE_CHECKING, Any

import grpc

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


class AccessGuard(grpc.aio.ServerInterceptor):
    """Asks `caller` who is behind the peer of each call; passes the reason of each refusal to `on_refused`."""

    def __init__(self, caller: Callable[[str], Caller | None], on_refused: Callable[[str], None]) -> None:
        self._caller = caller
        self._on_refused = on_refused

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
        return _wrap(handler, lambda context: self._admit(service, context))

    async def _admit(self, service: str, context: Any) -> None:
        """Abort the call (which raises) unless its caller may make it."""
        caller = self._caller(context.peer())
        if caller is None:
            await context.abort(grpc.StatusCode.UNAUTHENTICATED, "the connection has ended")
        elif caller.refusal is not None:
            text = with_remedy(caller.refusal, caller.identity.name)
            await context.abort(grpc.StatusCode.UNAUTHENTICATED, text)
        elif caller.identity.role not in _ALLOWED.get(service, frozenset()):
            self._on_refused(WRONG_ROLE)
            name, role = caller.identity.name, caller.identity.role.value
            await context.abort(
                grpc.StatusCode.PERMISSION_DENIED,
                f"the certificate of {name} has the role {role}, which may not use {service}",
            )


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
