"""The stage of the attacks: a running system, requests that go on meanwhile, and an attacker on the way.

    robot  wlan0, wwan0 behind NAT ──┐                ┌── cloud_a, cloud_b
                                     ├── internet ────┤
    control ─────────────────────────┘    (taps)      └── attacker: a host like any other

The attacker sees what passes the internet and puts what it likes on any cable there. Nothing else is a stand-in.
"""

from __future__ import annotations

import contextlib
import threading
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from lab import Lab, LabConfig, LinkProfile, robot, server
from lab.attacker.wire import Tap
from lab.system import CONTROL_METRICS_PORT, METRICS_PORT
from plr.controlplane.ca.files import write_atomically
from plr.protos.program.tls_files import CRL_FILE
from tests.support.calling import Call

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from lab.attacker.wire import Captured
    from lab.system import Part, System

CLOUDS = ("cloud_a", "cloud_b")
ATTACKER = "attacker"
ATTACKERS_PORT = 4444
SERVICES = [{"name": "/echo", "deadline_ms": 500, "lifetime_ms": 30_000, "idempotent": True}]
OFFERS = [{"name": "/echo"}, {"name": "/plan_path"}]
WLAN = LinkProfile(delay_ms=5, jitter_ms=2)
WWAN = LinkProfile(delay_ms=15, jitter_ms=5)
OURS = 0xD0
"""The upper half of the first byte of our datagrams."""
UNANSWERED_S = 2.0
"""Younger requests need not have their answers yet."""
COUNTED_S = 20.0
"""A sidecar on a busy machine has taken what came in this time."""
NOT_AN_ATTACK = ("send_buffer", "unsendable", "receive_", "expired", "unsent", "finished_unwatched", "stun_")
"""Reasons, by their beginnings, that tell of something else than a datagram refused."""


def attack_lab() -> Lab:
    """The lab with its attacker."""
    config = LabConfig(
        robots=(robot("robot"), robot("robot_2", ("eth9",))),
        clouds=(*(server(name) for name in CLOUDS), server(ATTACKER)),
    )
    return Lab(config, seed=1)


@dataclass(slots=True)
class World:
    """A running system under attack."""

    system: System
    taps: dict[str, Tap] = field(default_factory=dict)
    _call: Call | None = None

    @property
    def lab(self) -> Lab:
        return self.system.lab

    def start(self, policy: dict[str, Any] | None = None, *, rogue: str | None = None, **sidecars: Any) -> None:
        """Everything a user would start; `sidecars` go to the configuration of all of them.

        `rogue`: the cloud whose program somebody has changed (`lab.attacker.rogue_cloud`).
        """
        for name, profile in (("wlan0", WLAN), ("wwan0", WWAN)):
            self.lab.link(name, host="robot").set(profile)
        self.system.start_control_plane(**({} if policy is None else {"policy": policy}))
        for cloud in CLOUDS:
            self.system.start_node(f"{cloud}.echo", cloud, ["-m", "lab.echo", "serve"])
            module = "lab.attacker.rogue_cloud" if cloud == rogue else "plr.sidecar"
            self.system.start_cloud(cloud, OFFERS, module=module, **sidecars)
        self.system.wait_for_offer(self.start_robot(**sidecars))

    def start_robot(self, **changes: Any) -> Part:
        return self.system.start_robot(SERVICES, **changes)

    # -- the wire -------------------------------------------------------------------------------------------------

    def tap(self, host: str, interface: str | None = None) -> Tap:
        """A tap on the cable to a host's interface; what is sent on it goes to the host.

        A robot's is behind its NAT, as if the attacker were in the same wireless network: the NAT would let little
        through.
        """
        name = interface or self.lab.host(host).interfaces[0]
        key = f"{host} {name}"
        if key not in self.taps:
            if host.startswith("robot"):
                self.taps[key] = Tap(self.lab.nat(name, host=host).router, "lan0")
            else:
                # The internet's interface carries the number of the network it leads to.
                number = self.lab.host(host).address(name).split(".")[2]
                self.taps[key] = Tap(self.lab.host("internet"), f"to{number}")
        tap = self.taps[key]
        tap.frames()
        return tap

    @contextlib.contextmanager
    def roads_from(self, host: str) -> Iterator[list[Tap]]:
        """Taps on the internet's ends of all cables of a host behind NAT routers."""
        names = self.lab.host(host).interfaces
        numbers = [self.lab.nat(name, host=host).public_address.split(".")[2] for name in names]
        with contextlib.ExitStack() as stack:
            yield [stack.enter_context(Tap(self.lab.host("internet"), f"to{number}")) for number in numbers]

    @contextlib.contextmanager
    def nothing_reaches(self, tap: Tap) -> Iterator[None]:
        """The internet loses all UDP on its way to where the tap is: what gets there is sent by the attacker."""
        core = self.lab.host("internet")
        rule = f'type filter hook forward priority -300; oifname "{tap.interface}" meta l4proto udp drop;'
        core.run(["nft", "-f", "-"], input=f"table inet middle {{ chain lose {{ {rule} }}; }}\n", check=True)
        try:
            yield
        finally:
            core.run(["nft", "delete", "table", "inet", "middle"], check=True)

    def from_attacker(self, one: Captured) -> Captured:
        """The same datagram with the attacker's own address as its source."""
        family = 6 if ":" in one.source[0] else 4
        return one._replace(source=(self.lab.host(ATTACKER).address(family=family), ATTACKERS_PORT))

    def answers_to_attacker(self) -> list[Captured]:
        """What anybody sent to the attacker's port since the last look at its tap."""
        return [one for one in self.taps[f"{ATTACKER} eth0"].take() if one.destination[1] == ATTACKERS_PORT]

    def towards(self, tap: Tap, count: int) -> list[Captured]:
        """Wait for so many datagrams of ours on their way to the host of a tap."""
        return tap.wait_for(lambda one: one.outgoing and is_ours(one), count)

    # -- counters -------------------------------------------------------------------------------------------------

    def refusals(self, host: str) -> dict[str, float]:
        """Datagrams that a sidecar refused, by reason."""
        found: dict[str, float] = {}
        for series, value in self.system.metrics(host).items():
            name, _, labels = series.partition("{")
            if name == "plr_datagrams_dropped_total":
                reason = labels.partition('reason="')[2].partition('"')[0]
                if not reason.startswith(NOT_AN_ATTACK):
                    found[reason] = found.get(reason, 0.0) + value
        return found

    def wait_until_refused(self, host: str, before: dict[str, float], count: int, *reasons: str) -> None:
        """Wait until a sidecar counted so many refusals more than `before`, for one of these reasons."""
        end = time.monotonic() + COUNTED_S
        while True:
            now = self.refusals(host)
            more = {reason: value - before.get(reason, 0.0) for reason, value in now.items()}
            if sum(more.get(reason, 0.0) for reason in reasons or more) >= count:
                return
            assert time.monotonic() < end, f"{host}: {count} refusals as {reasons} expected, more than before: {more}"
            time.sleep(0.1)

    def counter(self, host: str, name: str, **labels: str) -> float:
        """The sum of a program's series of this name and labels."""
        port = CONTROL_METRICS_PORT if host == "control" else METRICS_PORT
        return sum(
            value
            for series, value in self.system.metrics(host, port).items()
            if series.partition("{")[0] == name and all(f'{key}="{wanted}"' in series for key, wanted in labels.items())
        )

    def control_counter(self, name: str, **labels: str) -> float:
        """The same of the control plane."""
        return self.counter("control", name, **labels)

    def wait_until_counted(self, name: str, count: float, **labels: str) -> None:
        """Wait until the control plane counted so many."""
        self.system.wait(
            f"{name} {labels} >= {count}", lambda: self.control_counter(name, **labels) >= count, COUNTED_S
        )

    # -- what operators do ----------------------------------------------------------------------------------------

    def revoke(self, name: str) -> None:
        """Revoke a node's certificates and give the control plane the new list."""
        self.system.authority.revoke(name)
        write_atomically(self.tls_dir("control") / CRL_FILE, self.system.authority.crl_pem(), 0o644)

    def tls_dir(self, name: str) -> Path:
        """The folder of certificates of one who was started."""
        return self.system.folder / f"{name}.tls"

    @contextlib.contextmanager
    def as_soon_as(self, logged: str, act: Callable[[], None]) -> Iterator[None]:
        """While the block runs, do something once the control plane has logged this."""
        over = threading.Event()

        def watch() -> None:
            while logged not in self.system.parts["controlplane"].log.read_text():
                if over.wait(0.05):
                    return
            act()

        thread = threading.Thread(target=watch)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()

    # -- legitimate traffic ---------------------------------------------------------------------------------------

    @contextlib.contextmanager
    def calls(self) -> Iterator[None]:
        """Requests at 20 Hz go on beside the attack, and after it: `end_calls` tells what became of all of them."""
        if self._call is None:
            self._call = Call(self.system, "--rate", "20", "--duration", "7200")
            self._call.wait_until_sending()
        yield

    def end_calls(self) -> int:
        """End the requests; returns how many there were. Each has been answered once and rightly."""
        call, self._call = self._call, None
        if call is None:
            return 0
        run = call.interrupt()
        summary, requests = run["summary"], run["requests"]
        assert summary["answered_twice"] == summary["invalid"] == summary["strangers"] == 0, summary
        # The last ones were on their way when it was interrupted.
        over = requests[-1]["sent_s"] - UNANSWERED_S
        unanswered = [one for one in requests if one["latency_ms"] is None and one["sent_s"] < over]
        assert unanswered == [], f"{len(unanswered)} of {len(requests)}"
        return len(requests)

    def close(self) -> None:
        for tap in self.taps.values():
            tap.__exit__(None, None, None)
        self.system.close()


def is_ours(one: Captured) -> bool:
    """Whether it is a datagram of the data plane that an attacker can put on the wire whole."""
    return len(one.payload) <= 1400 and bool(one.payload) and one.payload[0] & 0xF0 == OURS


def send_all(tap: Tap, datagrams: Sequence[Captured]) -> None:
    """Put them on the wire, not all at once."""
    for number, one in enumerate(datagrams):
        tap.send(one)
        if number % 50 == 49:
            time.sleep(0.01)
