"""What the operator asks of a large fleet: in parts, in turns of the loop, and from programs of the version before."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import grpc
import pytest

from plr.controlplane import turns
from plr.controlplane.cli.__main__ import main
from plr.controlplane.config.controlplane import ControlPlaneConfig
from plr.controlplane.core.registry.registry import Refusal
from plr.controlplane.loop import ControlLoop
from plr.controlplane.observe.event_log import EventLog
from plr.controlplane.observe.metrics import Metrics
from plr.controlplane.serve import admin
from plr.controlplane.serve.admin import AdminService
from plr.protos.convert import status_from_proto
from plr.protos.model.fleet_events import EventKind
from plr.protos.model.ids import InterfaceName, NodeName, Role
from plr.protos.model.members import CandidateSet, ServiceSet
from plr.protos.model.report import PathReport, Report
from plr.protos.plr.v1 import admin_pb2, admin_pb2_grpc
from tests.support.samples import PLAN, histogram, interfaces, offer, registration, use

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from plr.protos.model.stream import SidecarMessage

    Ask = Callable[[admin_pb2_grpc.AdminAsyncStub, ControlLoop], Awaitable[None]]

ROBOTS = 90
BAD = "robot-07"
CLOUDS = ("cloud-a", "cloud-b")


def make_loop() -> ControlLoop:
    """A loop that knows a fleet; one robot has a path that is down."""
    loop = ControlLoop(ControlPlaneConfig(insecure=True, listen="127.0.0.1:0"), Metrics(), EventLog(None))

    def join(name: str, role: Role, services: ServiceSet, *messages: Report) -> None:
        registered = loop.register(registration(name, role), None)
        assert not isinstance(registered, Refusal)
        told: list[SidecarMessage] = [CandidateSet(interfaces("wlan0")), services, *messages]
        for message in told:
            loop.receive(registered[0], message)

    for cloud in CLOUDS:
        join(cloud, Role.CLOUD, ServiceSet(offers=(offer(),)))
    for number in range(ROBOTS):
        name = f"robot-{number:02}"
        paths = tuple(
            PathReport(InterfaceName("wlan0"), NodeName(cloud), name != BAD, histogram(0.02, times=3), 90, 1)
            for cloud in CLOUDS
        )
        join(name, Role.ROBOT, ServiceSet(uses=(use(),)), Report((), paths))
    return loop


def serve(ask: Ask) -> None:
    async def run() -> None:
        loop = make_loop()
        server = grpc.aio.server()
        AdminService(loop).add_to(server)
        port = server.add_insecure_port("127.0.0.1:0")
        await server.start()
        try:
            async with grpc.aio.insecure_channel(f"127.0.0.1:{port}") as channel:
                await ask(admin_pb2_grpc.AdminStub(channel), loop)
        finally:
            await server.stop(None)

    asyncio.run(run())


async def together(
    stub: admin_pb2_grpc.AdminAsyncStub, request: admin_pb2.StreamStatusRequest
) -> tuple[admin_pb2.GetStatusResponse, int]:
    """The answer put together, and in how many parts it came."""
    answer, parts = admin_pb2.GetStatusResponse(), 0
    async for part in stub.StreamStatus(request):
        answer.MergeFrom(part)
        parts += 1
    return answer, parts


@pytest.mark.audit("ops-19")
def test_the_parts_are_the_whole_and_each_is_a_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(turns, "TURN_S", 0.0)

    async def ask(stub: admin_pb2_grpc.AdminAsyncStub, loop: ControlLoop) -> None:
        loop.events.record(EventKind.POLICY, text="none")
        answer, parts = await together(stub, admin_pb2.StreamStatusRequest())
        whole = await stub.GetStatus(admin_pb2.GetStatusRequest())
        assert parts > ROBOTS
        assert [one.peer.name for one in status_from_proto(answer)] == sorted(
            [*CLOUDS, *(f"robot-{number:02}" for number in range(ROBOTS))]
        )
        assert not any(one.abridged for one in answer.sidecars)
        assert [event.text for event in whole.events][-1] == "none"
        for found in (answer, whole):
            for one in found.sidecars:
                one.lease_left_us = 0
        assert answer == whole

    serve(ask)


@pytest.mark.audit("ops-19")
def test_of_many_those_in_order_are_told_in_short() -> None:
    async def ask(stub: admin_pb2_grpc.AdminAsyncStub, loop: ControlLoop) -> None:
        answer, _ = await together(stub, admin_pb2.StreamStatusRequest(detailed_at_most=ROBOTS))
        in_full = [one.peer.name for one in answer.sidecars if not one.abridged]
        assert in_full == [BAD]
        assert [path.up for one in answer.sidecars for path in one.paths] == [False, False]
        few, _ = await together(stub, admin_pb2.StreamStatusRequest(detailed_at_most=ROBOTS + len(CLOUDS)))
        assert not any(one.abridged for one in few.sidecars)

    serve(ask)


@pytest.mark.audit("ops-19")
def test_named_ones_are_told_alone_and_unknown_ones_are_left_out() -> None:
    async def ask(stub: admin_pb2_grpc.AdminAsyncStub, loop: ControlLoop) -> None:
        request = admin_pb2.StreamStatusRequest(names=["robot-03", "nobody"], detailed_at_most=1)
        answer, _ = await together(stub, request)
        assert [one.peer.name for one in answer.sidecars] == ["robot-03"]
        with pytest.raises(grpc.aio.AioRpcError) as caught:
            await together(stub, admin_pb2.StreamStatusRequest(names=["no name"]))
        assert caught.value.code() is grpc.StatusCode.INVALID_ARGUMENT

    serve(ask)


@pytest.mark.audit("ops-19")
def test_a_fleet_too_large_for_one_message_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(admin, "MAX_STATUS_BYTES", 4000)

    async def ask(stub: admin_pb2_grpc.AdminAsyncStub, loop: ControlLoop) -> None:
        with pytest.raises(grpc.aio.AioRpcError) as caught:
            await stub.GetStatus(admin_pb2.GetStatusRequest())
        assert caught.value.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
        assert "newer plr" in str(caught.value.details())
        answer, _ = await together(stub, admin_pb2.StreamStatusRequest())
        assert len(answer.sidecars) == ROBOTS + len(CLOUDS)

    serve(ask)


@pytest.mark.audit("ops-19")
def test_events_come_in_one_message_made_in_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(turns, "TURN_S", 0.0)

    async def ask(stub: admin_pb2_grpc.AdminAsyncStub, loop: ControlLoop) -> None:
        answer = await stub.ListEvents(admin_pb2.ListEventsRequest(last=70))
        kept = [event.number for event in loop.events.events()]
        assert [event.number for event in answer.events] == kept[-70:]
        assert answer.left_out == len(kept) - 70
        assert answer.log.kept == len(kept)

    serve(ask)


def test_an_explanation_comes_in_one_message_made_in_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(turns, "TURN_S", 0.0)

    async def ask(stub: admin_pb2_grpc.AdminAsyncStub, loop: ControlLoop) -> None:
        granted = 0
        real = turns._one_turn

        def one_turn(*given: Any) -> Any:
            nonlocal granted
            granted += 1
            return real(*given)

        monkeypatch.setattr(turns, "_one_turn", one_turn)
        answer = await stub.Explain(admin_pb2.ExplainRequest(robot=BAD, service=PLAN))
        assert (answer.robot, answer.service) == (BAD, PLAN)
        assert granted > len(answer.pairs)
        with pytest.raises(grpc.aio.AioRpcError) as caught:
            await stub.Explain(admin_pb2.ExplainRequest(robot="nobody", service=PLAN))
        assert caught.value.code() is grpc.StatusCode.NOT_FOUND

    serve(ask)


@pytest.mark.audit("ops-10")
def test_plr_status_of_a_control_plane_of_the_version_before(capsys: pytest.CaptureFixture[str]) -> None:
    async def run() -> tuple[int, int]:
        server = grpc.aio.server()
        methods: dict[str, grpc.RpcMethodHandler[Any, Any]] = {
            "GetStatus": grpc.unary_unary_rpc_method_handler(AdminService(make_loop()).get_status)
        }
        server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(admin.SERVICE_NAME, methods),))
        port = server.add_insecure_port("127.0.0.1:0")
        await server.start()
        try:
            options = ["status", "--insecure", "--address", f"127.0.0.1:{port}", "--timeout-s", "30"]
            everybody = await asyncio.to_thread(main, options)
            return everybody, await asyncio.to_thread(main, [*options, "robot-03", "nobody"])
        finally:
            await server.stop(None)

    everybody, some = asyncio.run(run())
    text, errors = capsys.readouterr()
    assert everybody == 0
    assert text.count("\nrobot-07 ") == 1, "the table of all"
    assert text.count("\nrobot-03:\n") == 2, "those named too"
    assert some == 1
    assert (
        errors == "plr: nobody is not registered; plr status shows which are, plr events --node nobody shows its past\n"
    )
