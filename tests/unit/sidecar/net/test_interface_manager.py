"""The manager's looks, one by one, at interfaces that the test makes up; the sockets are real ones on lo."""

from __future__ import annotations

import socket
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest

from lab.simulated.sessions import session_of
from plr.protos.model.ids import InterfaceName, Role
from plr.sidecar.config.service import ServiceConfig
from plr.sidecar.config.sidecar import SidecarConfig, StunConfig
from plr.sidecar.core.interfaces.scan_schedule import RETRY_S
from plr.sidecar.core.seam.links import SetCarrier
from plr.sidecar.net import interface_manager as module
from plr.sidecar.net.interface_manager import InterfaceManager
from plr.sidecar.net.interfaces import Interface
from plr.sidecar.net.netlink_watch import Changes

if TYPE_CHECKING:
    from collections.abc import Iterator

    from plr.protos.model.members import Candidate
    from plr.sidecar.net.interface_thread import InterfaceThread

LO = Interface(InterfaceName("lo"), 1, "", up=True, carrier=True, mtu=65536, addresses=("127.0.0.1",))
IDLE = Changes(any=False, gone_links=frozenset())


class Host:
    """What the manager sees, and whom it tells."""

    def __init__(self) -> None:
        self.interfaces: tuple[Interface, ...] = (LO,)
        self.error: Exception | None = None
        self.links: dict[InterfaceName, InterfaceThread] = {}
        self.candidates: tuple[Candidate, ...] = ()
        self.down: tuple[InterfaceName, ...] = ()
        self.changes = IDLE
        config = SidecarConfig(
            name="robot",
            role=Role.ROBOT,
            control_plane=("127.0.0.1:1",),
            insecure=True,
            services=(ServiceConfig(name="/echo", deadline_ms=100),),
            interfaces=("lo",),
            stun=StunConfig(enabled=False),
        )
        data_plane: Any = self
        own = session_of("robot", Role.ROBOT, 1)
        self.manager = InterfaceManager(config, own, bytes(16), data_plane, self._candidates)
        watch: Any = self.manager._watch
        watch.wait = lambda timeout_s: self.changes

    def look_up(self) -> tuple[Interface, ...]:
        if self.error is not None:
            raise self.error
        return self.interfaces

    def look(self, *interfaces: Interface) -> None:
        self.interfaces = interfaces
        self.manager._scan()

    def set_links(self, links: dict[InterfaceName, InterfaceThread]) -> None:
        self.links = links

    def on_link_events(self, events: list[Any]) -> None:
        pass

    def _candidates(self, candidates: tuple[Candidate, ...], down: tuple[InterfaceName, ...]) -> None:
        self.candidates = candidates
        self.down = down


@pytest.fixture
def host(monkeypatch: pytest.MonkeyPatch) -> Iterator[Host]:
    host = Host()
    monkeypatch.setattr(module, "list_interfaces", host.look_up)
    yield host
    for managed in host.manager._managed.values():
        managed.stop()
    host.manager._watch.close()


def addresses(host: Host) -> list[str]:
    return [candidate.address[0] for candidate in host.candidates]


def test_an_interface_without_carrier_keeps_its_thread_and_is_offered_to_nobody(host: Host) -> None:
    host.look(LO)
    thread = host.links[LO.name]
    assert addresses(host) == ["127.0.0.1"]
    host.look(replace(LO, carrier=False))
    assert host.candidates == ()
    host.look(LO)
    assert addresses(host) == ["127.0.0.1"]
    assert host.links[LO.name] is thread


def test_an_interface_that_lost_its_address_says_so(host: Host, monkeypatch: pytest.MonkeyPatch) -> None:
    host.look(LO)
    posted: list[object] = []
    monkeypatch.setattr(host.manager._managed[LO.name], "_post", posted.append)
    host.look(replace(LO, addresses=()))
    assert posted == [SetCarrier(on=False, why_not="no address")]


@pytest.mark.audit("ops-13")
def test_an_mtu_that_is_too_small_is_warned_of(host: Host, caplog: pytest.LogCaptureFixture) -> None:
    host.look(replace(LO, mtu=1228))
    assert caplog.text == ""
    host.look(replace(LO, mtu=1227))
    host.look(replace(LO, mtu=1227))
    (record,) = caplog.records
    assert record.getMessage().startswith("lo: its MTU of 1227 is below 1228: ")


@pytest.mark.audit("ops-13")
def test_a_wanted_interface_that_carries_nothing_is_reported_by_name(host: Host) -> None:
    host.look()
    assert list(host.down) == ["lo"], "named by the configuration, and not there at boot"
    host.look(LO)
    assert (addresses(host), list(host.down)) == (["127.0.0.1"], [])
    host.look(replace(LO, carrier=False))
    assert (addresses(host), list(host.down)) == ([], ["lo"])


@pytest.mark.audit("ops-13")
def test_a_port_that_a_glob_matches_is_reported_only_when_it_was_in_use(host: Host) -> None:
    host.manager._config = host.manager._config.model_copy(update={"interfaces": ("lo*",)})
    never = replace(LO, name=InterfaceName("lo-spare"), index=77, carrier=False)
    host.look(LO, never)
    assert list(host.down) == []
    host.look(replace(LO, carrier=False), never)
    assert list(host.down) == ["lo"]


def test_an_announced_end_of_a_link_suspends_it_before_any_look(host: Host) -> None:
    host.look(LO)
    host.error = AssertionError("looked")
    host.changes = Changes(any=True, gone_links=frozenset({1}))
    host.manager._turn(0.0)
    assert host.manager._managed[LO.name].suspended


def test_another_device_of_the_same_name_gets_a_new_socket_and_goes_on_with_the_packet_numbers(host: Host) -> None:
    host.look(LO)
    thread = host.links[LO.name]
    thread.link._table._memory.next_number = 1000
    host.look(replace(LO, index=7))
    again = host.links[LO.name]
    assert again is not thread
    assert again.link._table.next_number == 1000
    assert again.link.identity.interface_id == thread.link.identity.interface_id


def test_an_interface_that_is_renamed_away_is_let_go(host: Host) -> None:
    host.look(LO)
    host.look(replace(LO, name=InterfaceName("lan7")))
    assert host.links == {}
    assert host.candidates == ()


def test_a_changed_address_is_offered(host: Host) -> None:
    host.look(LO)
    host.look(replace(LO, addresses=("127.0.0.2", "127.0.0.1")))
    assert addresses(host) == ["127.0.0.2", "127.0.0.1"]


@pytest.mark.parametrize("error", [OSError("netlink is away"), ValueError("a bug")])
def test_a_failed_look_is_repeated(host: Host, error: Exception, caplog: pytest.LogCaptureFixture) -> None:
    host.look(LO)
    host.error = error
    host.manager._schedule.changed(0.0)
    host.manager._schedule._due = 0.0
    host.manager._turn(0.0)
    assert str(error) in caplog.text
    assert host.manager._wait_s() <= RETRY_S
    assert LO.name in host.links


def test_a_refused_socket_is_tried_again_soon(host: Host, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> Any:
        raise OSError("taken")

    with monkeypatch.context() as refusing:
        refusing.setattr(module, "ManagedInterface", refuse)
        host.look(LO)
    assert host.links == {}
    assert host.manager._wait_s() <= RETRY_S
    host.look(LO)
    assert list(host.links) == [LO.name]


@pytest.mark.audit("ops-14")
def test_a_port_that_is_taken_is_no_lack_of_interfaces(host: Host, caplog: pytest.LogCaptureFixture) -> None:
    with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as taken:
        taken.bind(("::", 0))
        port = taken.getsockname()[1]
        host.manager._config = host.manager._config.model_copy(update={"udp_port": port})
        host.look(LO)
        why = f"its socket could not be opened: Address already in use (udp_port {port})"
        assert host.manager.unopened() == {"lo": why}
        assert (host.manager.in_use(), list(host.down)) == ({"lo": False}, ["lo"])
        (warning,) = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
        assert warning == f"no interface is in use, so no request can be carried (lo: {why})"
    host.look(LO)
    assert (host.manager.unopened(), host.manager.in_use()) == ({}, {"lo": True})
