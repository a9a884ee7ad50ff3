"""What waits for one stream stays bounded and in order."""

from __future__ import annotations

import asyncio

from plr.controlplane.core.publish.messages import CloseReason
from plr.controlplane.serve.mailbox import Mailbox
from plr.protos.model.ids import NodeName, Role, SessionId, Version
from plr.protos.model.mapping import MappingSet
from plr.protos.model.members import Peer, PeerSet, RemovalReason, RemovedPeer
from plr.protos.model.stream import Welcome

WELCOME = Welcome(5.0, 0.5)


def peers(version: int) -> PeerSet:
    return PeerSet(Version(version), version)


def mapping(version: int) -> MappingSet:
    return MappingSet(Version(version), version)


async def take(mailbox: Mailbox, count: int) -> list[object]:
    return [await mailbox.get() for _ in range(count)]


def test_a_newer_resource_takes_the_place_of_an_unsent_older_one() -> None:
    async def scenario() -> None:
        mailbox = Mailbox()
        for version in range(1, 1001):
            mailbox.put(mapping(version))
            mailbox.put(peers(version))
        mailbox.put(WELCOME)
        # A mapping goes after the peers it names, whatever the order of their changes.
        assert await take(mailbox, 3) == [WELCOME, peers(1000), mapping(1000)]
        assert mailbox.superseded == 2 * 999

    asyncio.run(scenario())


def test_unsent_changes_are_put_together() -> None:
    async def scenario() -> None:
        mailbox = Mailbox()
        mailbox.put(PeerSet(Version(5), 1, (peer("a"), peer("b")), base=Version(4)))
        mailbox.put(PeerSet(Version(6), 2, (peer("c"),), (gone("a"),), base=Version(5)))
        assert await mailbox.get() == PeerSet(Version(6), 2, (peer("b"), peer("c")), (gone("a"),), base=Version(4))
        mailbox.put(PeerSet(Version(7), 3, (peer("d"),)))
        mailbox.put(PeerSet(Version(8), 4, (), (gone("d"),), 77, base=Version(7)))
        assert await mailbox.get() == PeerSet(Version(8), 4, (), (gone("d"),), 77)

    asyncio.run(scenario())


def peer(name: str) -> Peer:
    return Peer(NodeName(name), Role.CLOUD, SessionId(1), bytes(16), 1)


def gone(name: str) -> RemovedPeer:
    return RemovedPeer(NodeName(name), RemovalReason.LEFT)


def test_waiting_ends_with_a_message_or_with_the_close() -> None:
    async def scenario() -> None:
        mailbox = Mailbox()
        async with asyncio.TaskGroup() as tasks:
            waiting = tasks.create_task(take(mailbox, 2))
            await asyncio.sleep(0)
            mailbox.put(peers(1))
            await asyncio.sleep(0)
            await asyncio.sleep(0)
            mailbox.put(mapping(1))
            mailbox.close(CloseReason.REPLACED)
        first, second = waiting.result()
        assert first == peers(1)
        # What is unsent when a stream is closed would only be superseded by the next stream.
        assert second is CloseReason.REPLACED

    asyncio.run(scenario())
