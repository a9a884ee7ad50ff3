"""What a link takes of the exchange of keys, and of who has but one end's session key: nothing that moves a request."""

from __future__ import annotations

import random
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest

from lab.simulated.sessions import credential_of, seal, session_of
from plr.protos.base.errors import DecodeError
from plr.protos.model.ids import InterfaceId, NodeName, Role, SessionId
from plr.sidecar.core.link.link import Link
from plr.sidecar.core.link.sender import LinkIdentity
from plr.sidecar.core.path.congestion.rtt import LONGEST_ANSWER_S
from plr.sidecar.core.path.key_exchange import DEFAULT_LIMITS, EXCHANGES_AT_ONCE
from plr.sidecar.core.path.keys import make_path_keys
from plr.sidecar.core.path.pmtu import HEADERS_V4
from plr.sidecar.core.seam.links import LinkPeer, SetMtu, SetPeers, SetReady
from plr.sidecar.core.wire import frame
from plr.sidecar.core.wire.frame import BASE_BYTES, Header, KeyAnswer, KeyOffer, Probe, ProbeReply
from plr.sidecar.core.wire.introduction import encode_introduction
from tests.support.builders import OUR_ID, OUR_TOKEN, PEER_ADDRESS, WLAN, Bench, peer
from tests.unit.sidecar.core.link.test_link import PROBE, fragment, up

if TYPE_CHECKING:
    from plr.sidecar.core.path.keys import PathKeys

RNG = random.Random(3)

EARLY = {
    "fragment": fragment(),
    "acknowledgement": frame.encode_ack([(0, 0)], 0.0),
    "finished": frame.encode_finished(frame.Finished(1)),
    "abandon": frame.encode_abandon(frame.Abandon(1)),
    "forgotten": frame.encode_forgotten(frame.Forgotten(1)),
    "close": frame.encode_close(),
}


def without_fresh_keys() -> Bench:
    bench = Bench(exchanges_keys=False)
    bench.sent()
    return bench


@pytest.mark.audit("sec-9")
@pytest.mark.parametrize("kind", EARLY)
def test_before_fresh_keys_a_path_carries_nothing_but_probes(kind: str) -> None:
    bench = without_fresh_keys()
    bench.receive(EARLY[kind], PROBE)
    assert bench.events() == []
    assert bench.link.stats.dropped == {"before_fresh_keys": 1}
    assert ProbeReply(1) in bench.frames(bench.sent())


@pytest.mark.audit("sec-9")
@pytest.mark.parametrize("kind", EARLY)
def test_nor_in_one_batch_with_the_first_that_is_sealed_with_fresh_keys(kind: str) -> None:
    """The kernel hands over datagrams of one address together: what opened with older keys is not read as of newer."""
    bench = without_fresh_keys()
    early = bench.datagram(EARLY[kind] + bytes(200 - len(EARLY[kind])), number=0)
    (path,) = bench.link._paths.values()
    robot, cloud = path.keys, bench.peer_keys()
    offer = robot.offer(bench.now, RNG)
    assert offer is not None
    answer = cloud.answer(offer, bench.now, RNG)
    assert answer is not None
    assert robot.take(answer, bench.now)
    cloud.opening.advance(0)
    assert cloud.follow(bench.now)
    first = bench.datagram(PROBE + bytes(200 - len(PROBE)), number=1)
    assert len(early) == len(first)
    bench.link.receive_batch(memoryview(early + first), len(first), PEER_ADDRESS, bench.now)
    assert not [event for event in bench.events() if type(event).__name__ not in {"PathChanged", "PathMeasured"}]
    assert bench.link.stats.dropped == {"before_fresh_keys": 1}
    assert ProbeReply(1) in bench.frames(bench.sent())


@pytest.mark.audit("sec-9")
def test_a_path_does_not_come_up_by_probes_that_are_answered_with_the_keys_of_the_sessions() -> None:
    bench = without_fresh_keys()
    for _ in range(20):
        for item in bench.frames(bench.wait(0.2)):
            if isinstance(item, Probe):
                bench.receive(frame.encode_probe_reply(ProbeReply(item.id)))
    assert bench.link.living() == []


@pytest.mark.audit("sec-9")
@pytest.mark.parametrize("stolen", [Role.ROBOT, Role.CLOUD])
def test_who_has_one_ends_session_key_is_not_taken_for_the_other_end(stolen: Role) -> None:
    """It computes all of phase 0, and offers or answers; what follows takes the other session's key as well."""
    robot, cloud = session_of("robot-1", Role.ROBOT, 7), session_of("cloud-a", Role.CLOUD, 8)
    of_cloud = robot.admit(peer("cloud-a", session=8))
    of_robot = cloud.admit(peer("robot-1", session=7, role=Role.ROBOT))
    one, other = InterfaceId(1), InterfaceId(2)
    honest_robot = make_path_keys(of_cloud, one, other, DEFAULT_LIMITS, 0.0, leads=True)
    honest_cloud = make_path_keys(of_robot, other, one, DEFAULT_LIMITS, 0.0, leads=False)
    if stolen is Role.ROBOT:
        # What the thief computes in the cloud's place: it lacks the cloud's private key, and uses the robot's.
        thief = make_path_keys(replace(of_robot, own=of_cloud.own), other, one, DEFAULT_LIMITS, 0.0, leads=False)
        offer = honest_robot.offer(0.0, RNG)
        assert offer is not None
        answer = thief.answer(offer, 0.0, RNG)
        assert answer is not None
        with pytest.raises(DecodeError):
            honest_robot.take(answer, 0.0)
        return
    thief = make_path_keys(replace(of_cloud, own=of_robot.own), one, other, DEFAULT_LIMITS, 0.0, leads=True)
    offer = thief.offer(0.0, RNG)
    assert offer is not None
    answer = honest_cloud.answer(offer, 0.0, RNG)
    assert answer is not None, "that it knows the keys in use is true"
    with pytest.raises(DecodeError):
        thief.take(answer, 0.0)
    assert not honest_cloud.follow(0.0)
    assert honest_cloud.sealing.phase == 0


@pytest.mark.audit("sec-9")
def test_wrong_answers_are_looked_at_a_few_times_a_second() -> None:
    """Each is 0.3 ms of public-key work: a member that sends thousands of them must not keep a processor busy."""
    bench = without_fresh_keys()
    (offer,) = [path.keys.offer(bench.now, RNG) for path in bench.link._paths.values()]
    assert offer is not None
    for number in range(500):
        answer = KeyAnswer(1, RNG.randbytes(32), bytes(16))
        bench.receive(frame.encode_key_answer(answer), number=number)
        bench.now += 0.001
    looked = bench.link.stats.dropped["bad_keys"]
    assert looked <= EXCHANGES_AT_ONCE + 10 * 0.5 + 1
    assert looked + bench.link.stats.dropped["exchanges_full"] == 500
    bench.now += 1.0
    right = bench.peer_keys().answer(offer, bench.now, RNG)
    assert right is not None
    bench.receive(frame.encode_key_answer(right), number=1000)
    assert bench.link.living() != [], "the right one has its turn"


@pytest.mark.parametrize("two", ["offers", "answers", "both"])
def test_a_datagram_holds_one_offer_or_answer(two: str) -> None:
    offer = frame.encode_key_offer(KeyOffer(1, bytes(32), bytes(16)))
    answer = frame.encode_key_answer(KeyAnswer(1, bytes(32), bytes(16)))
    plain = {"offers": 2 * offer, "answers": 2 * answer, "both": offer + answer}[two]
    with pytest.raises(DecodeError, match="more than one"):
        frame.decode_frames(memoryview(plain))


def test_an_offer_that_came_twice_is_answered_once_in_the_next_datagram() -> None:
    bench = CloudBench()
    robot = bench.keys(4)
    offer = robot.offer(bench.now, RNG)
    assert offer is not None
    bench.introduce(4, 0, None)
    for number in (1, 2):
        plain = frame.encode_probe(Probe(number)) + frame.encode_key_offer(offer)
        bench.receive(seal(robot.sealing, Header(InterfaceId(4), OUR_ID, SessionId(7), number), plain))
    bench.link.handle_timer(bench.now)
    (answer,) = [item for one in bench.sent() for item in bench.opened(robot, one) if isinstance(item, KeyAnswer)]
    assert robot.take(answer, bench.now)


@pytest.mark.audit("sec-5")
def test_an_introduction_made_up_with_the_token_alone_does_not_keep_the_peers_own_out() -> None:
    bench = CloudBench()
    robot = bench.keys(4)
    offer = robot.offer(bench.now, RNG)

    def answers(number: int, offered: KeyOffer | None) -> int:
        """Our own introductions, to where the peer seems to be, do not count."""
        sent = bench.introduce(4, number, offered)
        return sum(not datagram[1] & frame.INTRODUCTION_FLAG for datagram in sent)

    assert answers(5, offer) == 1
    assert answers(2**64 - 1, None) == 1, "made up"
    assert answers(5, offer) == 0, "recorded"
    assert answers(6, None) == 0, "nobody knows whose it is"
    assert bench.link.stats.dropped == {"duplicate": 2}
    assert answers(7, offer) == 1
    assert answers(7, offer) == 0
    assert answers(8, KeyOffer(1, bytes(31) + b"\x09", bytes(16))) == 0
    assert bench.link.stats.dropped == {"duplicate": 3, "bad_keys": 1}


@pytest.mark.audit("sec-1")
def test_a_name_that_was_revoked_and_given_again_is_talked_to_whatever_the_one_before_left() -> None:
    bench = CloudBench()
    bench.link._table._memory._forget_up_to(NodeName("robot-1"), 2**64 - 1)
    bench.introduce(4, 0, bench.keys(4).offer(bench.now, RNG))
    assert bench.link.stats.dropped == {"forgotten_session": 1}
    bench.known = replace(bench.known, era=1)
    bench.know()
    assert len(bench.introduce(4, 1, bench.keys(4).offer(bench.now, RNG))) == 1


class CloudBench:
    """A cloud's link, and the robot's end of its paths, which the test writes."""

    def __init__(self) -> None:
        self.now = 1.0
        self.robot, self.cloud = session_of("robot-1", Role.ROBOT, 7), session_of("cloud-a", Role.CLOUD, 8)
        identity = LinkIdentity.of(self.cloud.credential, bytes(16), WLAN, OUR_ID)
        self.link = Link(identity, random.Random(1), self.now)
        self.link.execute(SetMtu(BASE_BYTES + HEADERS_V4), self.now)
        self.link.execute(SetReady(ready=True), self.now)
        subject = peer("robot-1", session=7, role=Role.ROBOT)
        self.known = LinkPeer(
            subject.name, subject.session, OUR_TOKEN, 1, subject.credential, self.cloud.admit(subject), ()
        )
        self.know()
        self.of_cloud = self.robot.admit(peer("cloud-a", session=8))

    def know(self) -> None:
        self.link.execute(SetPeers((self.known,)), self.now)

    def keys(self, interface: int) -> PathKeys:
        """The robot's."""
        return make_path_keys(self.of_cloud, InterfaceId(interface), OUR_ID, DEFAULT_LIMITS, self.now, leads=True)

    def introduce(self, interface: int, number: int, offer: KeyOffer | None) -> list[bytes]:
        header = Header(InterfaceId(interface), OUR_ID, SessionId(7), number)
        credential = credential_of("robot-1", Role.ROBOT, 7).encode()
        self.receive(encode_introduction(header, OUR_TOKEN, NodeName("cloud-a"), 77, credential, offer))
        return self.sent()

    def sent(self) -> list[bytes]:
        return [bytes(one) for batch in self.link.batches_to_send(self.now) for one in batch.cut()]

    def receive(self, datagram: bytes) -> None:
        self.link.receive_batch(memoryview(datagram), len(datagram), PEER_ADDRESS, self.now)

    def opened(self, keys: PathKeys, datagram: bytes) -> list[frame.Frame]:
        if datagram[1] & frame.INTRODUCTION_FLAG:
            return []
        plain = bytearray(len(datagram) - 36)
        keys.opening.decrypt_into(datagram[8:20], datagram[20:], datagram[:20], plain)
        return frame.decode_frames(memoryview(plain))


@pytest.mark.audit("sec-9")
def test_an_answered_path_that_a_view_takes_away_is_known_again_when_it_comes_back() -> None:
    """The robot goes on with what was agreed on: a path that began again could never be understood."""
    bench, robot = CloudBench(), CloudBench().keys(4)
    answers = bench.introduce(4, 0, robot.offer(bench.now, RNG))
    (answer,) = [item for one in answers for item in bench.opened(robot, one) if isinstance(item, KeyAnswer)]
    bench.now += LONGEST_ANSWER_S
    bench.know()  # a view that does not name the interface, and nothing sealed has come for long
    assert bench.link._paths == {}
    assert robot.take(answer, bench.now)
    bench.now += 0.1
    bench.introduce(4, 1, robot.offer(bench.now, RNG))
    clear = frame.CLEAR.pack(robot.sealing.head, 7, 2)
    sealed = bytearray(len(PROBE) + 16)
    robot.sealing.encrypt_into(clear[8:], PROBE, clear, sealed)
    bench.receive(clear + bytes(sealed))
    assert bench.link.stats.dropped == {}
    assert len(bench.link.living()) == 1


@pytest.mark.audit("sec-9")
def test_a_robot_that_makes_up_interfaces_gets_few_exchanges() -> None:
    bench = CloudBench()
    answered = 0
    for number in range(10):
        for interface in range(0, 256, 2):
            keys = bench.keys(interface)
            sent = bench.introduce(interface, number, keys.offer(bench.now, RNG))
            answered += sum(isinstance(item, KeyAnswer) for one in sent for item in bench.opened(keys, one))
            bench.now += 0.0005
    assert answered <= EXCHANGES_AT_ONCE + 10 * 0.64 + 1


def test_the_keys_before_go_with_the_path() -> None:
    bench = up()
    (path,) = bench.link._paths.values()
    path.opening._previous = path.opening._current
    path.go_down()
    assert path.opening._previous is None
