"""Plays the day: members come, go, move and break at times drawn from a seed, and are compared in between."""

from __future__ import annotations

import math
import random
from collections import Counter
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from bench.fleetday.checks import Checker, is_healthy
from bench.fleetday.member import Measurements, Member
from bench.fleetday.plane import Plane
from bench.fleetday.sizes import Sizes, grown, measure
from bench.fleetday.timeline import Timeline
from plr.controlplane.core.base.member_table import MAX_MEMBERS
from plr.controlplane.core.control.events import Settings
from plr.controlplane.core.estimate.estimator import MAX_PAIRS_PER_ROBOT
from plr.controlplane.core.estimate.processing import MAX_PROCESSING
from plr.controlplane.core.estimate.reached import MAX_REACHED_PAIRS
from plr.controlplane.core.explain.departed import MAX_DEPARTED, MAX_EXPLAINED
from plr.controlplane.core.policy.policy import CallRule, OfferRule, Policy
from plr.controlplane.core.publish.history import MAX_HISTORIES, MAX_REMEMBERED_CHANGES
from plr.controlplane.core.publish.publisher import MAX_GONE_SNAPSHOTS
from plr.controlplane.core.publish.views import MAX_PERMITS_KEPT
from plr.controlplane.core.registry.registry import MAX_REMEMBERED_REMOVALS
from plr.protos.model.ids import InterfaceName, NodeName, Role, ServiceName
from plr.protos.model.members import RemovalReason, ServiceOffer, ServiceSet, ServiceUse

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path

    from plr.protos.model.ids import Address

HOUR_S = 3600.0
START = 1000.0
"""Start of simulated time."""

QUIET_S = 240.0
"""Quiet time before each measurement: longer than any spell, lease and settling together."""

RESTARTS_UNTIL = 0.3
"""Share of the day with restarts. One control plane runs through the rest, so that anything that grows has long to do
so; it is killed again at the end."""

SPELL_S = (20.0, 100.0)
"""How long a member refuses, reads slowly or has no network."""

SERVICES = tuple(ServiceName(name) for name in ("/plan", "/detect", "/grasp", "/map"))
TYPE = "nav_msgs/srv/GetPlan"
DEADLINES_S = (0.125, 0.25, 0.5)
WLAN, WWAN, WIRED = (InterfaceName(name) for name in ("wlan0", "wwan0", "eth0"))

GROWTH_SHARE = 0.3
"""Share by which a table may be larger in the second half of a day than in the first, besides some slack: the members
differ from hour to hour."""

CAPPED = {
    "departed._departures": MAX_DEPARTED,
    "departed._last_known": MAX_EXPLAINED,
    "history._histories": MAX_HISTORIES,
    "reached._pairs": MAX_REACHED_PAIRS,
    "reached._robots_of": MAX_REACHED_PAIRS,
    "reached._servers_of": MAX_REACHED_PAIRS,
    "reached._servers_of[]": MAX_REACHED_PAIRS,
    "history._histories[].changes": MAX_HISTORIES * MAX_REMEMBERED_CHANGES,
    "restlessness.shares._kept": MAX_MEMBERS,
    "urgency.shares._kept": MAX_MEMBERS,
    "registry.postponed.shares._kept": MAX_MEMBERS,
    "registry._shares.shares._kept": MAX_MEMBERS,
    "registry._removals": MAX_REMEMBERED_REMOVALS,
    "_publisher._gone": MAX_GONE_SNAPSHOTS,
    # Those made under the permits before: none until the policy changes for the first time.
    "_publisher._known_peers._former": MAX_MEMBERS,
    "_publisher._known_peers._former[]": MAX_MEMBERS * MAX_PERMITS_KEPT,
    "estimator._compute._servers": MAX_PROCESSING,
    # What was computed at the last look at a robot, of its pairs: as many as that one asked for.
    "estimator._robots[].troubles[]._met[]": MAX_MEMBERS * MAX_PAIRS_PER_ROBOT,
}
"""Tables that remember departed members, or what was computed last, with their caps."""

POLICIES: tuple[Policy | None, ...] = (
    None,
    Policy((CallRule(("*",), ("*",), ("*",)),), (OfferRule(("*",), ("*",)),)),
    Policy((CallRule(("robot-*[02468]",), ("*",), ("*",)),), (OfferRule(("*",), ("*",)),)),
    Policy((CallRule(("*",), ("/plan", "/detect"), ("*",)),), (OfferRule(("*",), ("/[pdg]*",)),)),
)


@dataclass(frozen=True, slots=True)
class Scale:
    """The size and length of a day."""

    members: int = 1000
    hours: float = 24.0
    every_hours: float = 4.0
    """Interval between measurements of all tables."""
    moment_s: float = 60.0
    """Mean interval between moments at which something happens."""
    events: int = 16
    """Most events that begin at one moment; their ends are drawn separately."""
    grid_s: float = 20.0
    """Events end within a second after a multiple of this, since solving and publishing for them together costs less;
    0 means at any time."""
    solving_s: float = 0.004
    """Simulated time that the matcher takes for each block, as if it had a small part of a processor."""
    look_s: float = 300.0
    """Interval between comparisons of the two sides."""
    measures_s: float = 300.0
    """Interval between measurements of a robot; its other reports say that paths went up or down."""
    slack: int = 200
    """Entries by which a table may grow in any case."""
    restarts: int = 6
    """Restarts of the control plane."""


@dataclass(frozen=True, slots=True)
class Sample:
    """The control plane at one time, after a quiet period."""

    at_h: float
    run: int
    """Number of the control plane's run."""
    registered: int
    judged: int
    sizes: Sizes
    sidecars: Sizes
    events_kept: int
    log_bytes: int


class Day:
    """A fleet and its control plane."""

    def __init__(self, seed: int, scale: Scale, folder: Path, *, matcher_settings: Settings | None = None) -> None:
        self.rng = random.Random(seed)
        self.scale = scale
        self.timeline = Timeline(START)
        self._folder = folder
        settings = matcher_settings or Settings(report_interval_s=0.9)
        self.plane = Plane(self.timeline, settings, folder, self.rng, solving_s=scale.solving_s)
        self.members: dict[NodeName, Member] = {}
        self.checker = Checker(self.plane, self.members)
        self.happened: Counter[str] = Counter()
        self.samples: list[Sample] = []
        self.on_sample: Callable[[Sample], None] = lambda sample: None
        self._measurements = Measurements(self.rng)
        self._numbers = 0
        self._address = 0
        self._quiet = False
        self._crls = 0
        self.judged_at_last = 0
        """Sidecars judged after the kill of the control plane at the end of the day."""
        weights: tuple[tuple[int, Callable[[], None]], ...] = (
            (25, self.rebinds),
            (15, self.loses_an_interface),
            (20, self.path_goes_dark),
            (10, self.breaks),
            (6, self.goes_half_open),
            (5, self.loses_its_network),
            (5, self.crashes),
            (5, self.leaves),
            (3, self.server_dies),
            (2, self.server_leaves),
            (4, self.changes_services),
            (3, self.refuses),
            (3, self.reads_slowly),
            (3, self.stalls),
            (2, self.renews),
            (1, self.is_revoked),
        )
        self._kinds = [kind for _, kind in weights]
        self._weights = [weight for weight, _ in weights]

    # ── the fleet ──

    @property
    def clouds_wanted(self) -> int:
        """Number of servers of the fleet."""
        return max(4, self.scale.members // 80)

    def _join(self, role: Role) -> Member:
        self._numbers += 1
        name = NodeName(f"{role.value}-{self._numbers:05d}")
        member = Member(
            name,
            role,
            self._numbers,
            self.rng.choice(("", "eu", "us")) if role is Role.CLOUD else "",
            timeline=self.timeline,
            plane=self.plane,
            rng=self.rng,
            measurements=self._measurements,
            measures_every_s=self.scale.measures_s,
        )
        names = [WIRED] if role is Role.CLOUD else [WLAN, WWAN]
        member.set_interfaces({name: self._addresses() for name in names})
        member.set_services(self._services(role))
        self.members[name] = member
        member.start(keeps_disk=False)
        return member

    def _addresses(self) -> tuple[Address, Address]:
        """Return a new host address, and its address behind a NAT."""
        self._address += 1
        number = self._address
        inside = f"10.{number >> 16 & 255}.{number >> 8 & 255}.{number & 255}"
        outside = f"198.18.{number >> 8 & 255}.{number & 255}"
        return (inside, 40_000), (outside, 1024 + number % 60_000)

    def _services(self, role: Role) -> ServiceSet:
        rng = self.rng
        if role is Role.CLOUD:
            offered = [SERVICES[0], *rng.sample(SERVICES[1:], rng.randint(1, 3))]
            return ServiceSet(tuple(ServiceOffer(name, TYPE) for name in sorted(offered)))
        used = sorted(rng.sample(SERVICES, rng.choice((1, 1, 2))))
        uses = (ServiceUse(name, TYPE, rng.choice(DEADLINES_S), idempotent=rng.random() < 0.8) for name in used)
        unmet = (ServiceName("/nobody"),) if rng.random() < 0.1 else ()
        return ServiceSet((), tuple(uses), unmet)

    def _alive(self, role: Role | None = None) -> list[Member]:
        return [
            member
            for member in self.members.values()
            if member.alive and not member.draining and role in (None, member.role)
        ]

    def _someone(self, role: Role | None = None) -> Member:
        return self.rng.choice(self._alive(role))

    def _later(self, least_s: float, most_s: float, action: Callable[[], object]) -> None:
        when = self.timeline.now + self.rng.uniform(least_s, most_s)
        if self.scale.grid_s and most_s > self.scale.grid_s:
            when = math.ceil(when / self.scale.grid_s) * self.scale.grid_s + self.rng.random()
        self.timeline.at(when, action)

    # ── what happens to a member ──

    def rebinds(self) -> None:
        """Make a NAT forget a binding: another address and port follow, as STUN finds a moment later."""
        robot = self._someone(Role.ROBOT)
        if robot.interfaces:
            interface = self.rng.choice(list(robot.interfaces))
            inside, _ = robot.interfaces[interface]
            robot.set_interfaces({**robot.interfaces, interface: (inside, self._addresses()[1])})

    def loses_an_interface(self) -> None:
        """Take an interface away, to return some time later with another address."""
        robot = self._someone(Role.ROBOT)
        if len(robot.interfaces) < 2:
            return
        lost = self.rng.choice(list(robot.interfaces))
        robot.set_interfaces({name: at for name, at in robot.interfaces.items() if name != lost})

        def back() -> None:
            robot.set_interfaces({**robot.interfaces, lost: self._addresses()})

        self._later(5.0, 600.0, back)

    def path_goes_dark(self) -> None:
        """Make an interface, or one path of it, carry nothing for a while."""
        robot = self._someone(Role.ROBOT)
        if not robot.interfaces:
            return
        interface = self.rng.choice(list(robot.interfaces))
        servers = list(robot.held.peers.table)
        dark = interface if self.rng.random() < 0.7 or not servers else (interface, self.rng.choice(servers))
        robot.dark.add(dark)
        robot.paths_changed()

        def lit() -> None:
            robot.dark.discard(dark)
            if robot.alive:
                robot.paths_changed()

        self._later(2.0, 300.0, lit)

    def breaks(self) -> None:
        """Reset a stream."""
        self._someone().break_line(half_open=False)

    def goes_half_open(self) -> None:
        """Let a stream die silently."""
        self._someone().break_line(half_open=True)

    def loses_its_network(self) -> None:
        """Block a member's stream and any new one."""
        member = self._someone()
        member.network_down = True
        member.break_line(half_open=True)

        def back() -> None:
            member.network_down = False

        self._later(*SPELL_S, back)

    def crashes(self) -> None:
        """Crash a robot's sidecar, or the whole robot; it is back soon."""
        self._down(self._someone(Role.ROBOT), 1.0, 1800.0)

    def _down(self, member: Member, least_s: float, most_s: float) -> None:
        member.crash(silently=self.rng.random() < 0.5)
        self._later(least_s, most_s, lambda: self._up(member))

    def _up(self, member: Member) -> None:
        if not member.alive and member.name in self.members:
            member.start(keeps_disk=self.rng.random() < 0.7)

    def leaves(self) -> None:
        """Let a robot say goodbye; it is back for its next shift, or another one replaces it."""
        self._goes(self._someone(Role.ROBOT))

    def _goes(self, member: Member) -> None:
        member.drain()
        self._later(1.0, 5.0, lambda: self._gone(member))

    def _gone(self, member: Member) -> None:
        member.crash(silently=False)
        if self.rng.random() < 0.5:
            self._later(30.0, 3600.0, lambda: self._up(member))
        else:
            self._replaced(member)

    def _replaced(self, member: Member) -> None:
        """Replace a member that never comes back by another one."""
        self._later(30.0, 1200.0, lambda: self._join_for(member))

    def _join_for(self, gone: Member) -> None:
        # Kept until now for checks of who is gone.
        self.members.pop(gone.name, None)
        self._join(gone.role)

    def server_dies(self) -> None:
        """Let a server and its host die."""
        clouds = self._alive(Role.CLOUD)
        if 3 * len(clouds) > 2 * self.clouds_wanted:
            self._down(self.rng.choice(clouds), 5.0, 900.0)

    def server_leaves(self) -> None:
        """Take a server out of service; often another one, of another name, replaces it."""
        clouds = self._alive(Role.CLOUD)
        if 3 * len(clouds) > 2 * self.clouds_wanted:
            self._goes(self.rng.choice(clouds))

    def changes_services(self) -> None:
        """Change the services that a robot carries, or that a server offers."""
        member = self._someone(Role.CLOUD if self.rng.random() < 0.2 else Role.ROBOT)
        member.set_services(self._services(member.role))

    def _spell(self, member: Member, name: str) -> None:
        setattr(member, name, True)

        def over() -> None:
            setattr(member, name, False)
            member.ill_at = self.timeline.now

        self._later(*SPELL_S, over)

    def refuses(self) -> None:
        """Make a sidecar take nothing for a while, as if its driver hung."""
        self._spell(self._someone(), "refuses")

    def refuse_all(self) -> None:
        """Make every sidecar refuse everything from now on."""
        for member in self._alive():
            member.refuses = True

    def reads_slowly(self) -> None:
        """Make a sidecar take seconds for a message, as if behind a bad link."""
        member = self._someone()
        self._spell(member, "slow")
        if member.line is not None:
            line = member.line
            line.slow_s = self.rng.uniform(0.5, 5.0)

            def over() -> None:
                line.slow_s = 0.0

            self._later(*SPELL_S, over)

    def stalls(self) -> None:
        """Make a sidecar read nothing for a minute, while it is still heard."""
        member = self._someone()
        member.stall(60.0)
        self._spell(member, "slow")

    def renews(self) -> None:
        """Give a member a new certificate, with which its stream restarts."""
        self._someone().renew_credential()

    def is_revoked(self) -> None:
        """Revoke a certificate, or let it expire."""
        member = self._someone(Role.ROBOT)
        ended = self.rng.random() < 0.5
        self._crls += not ended
        reason = RemovalReason.EXPIRED if ended else RemovalReason.REVOKED
        self.plane.revoke(member.name, reason, b"list %d" % self._crls)
        self._later(5.0, 30.0, lambda: self._sorted_out(member, ended))

    def _sorted_out(self, member: Member, ended: bool) -> None:
        if ended:
            self.plane.barred.discard(member.name)
            if member.alive:
                member.renew_credential()
        elif member.alive:
            member.crash(silently=False)
            self._replaced(member)

    # ── what happens to all ──

    def restart_plane(self) -> None:
        """Stop or kill the control plane, which is back soon, sometimes with a clock that was set back."""
        if self._quiet or not self.plane.up:
            self._later(QUIET_S, 2 * QUIET_S, self.restart_plane)
            return
        self.happened["restart_plane"] += 1
        self.plane.stop(orderly=self.rng.random() < 0.5)
        if self.rng.random() < 0.4:
            self.plane.clock_error_s = self.rng.choice((-7200.0, -600.0, 0.0, 3600.0))
        self._later(0.5, 40.0, self.plane.start)

    def change_policy(self) -> None:
        """Put another policy into force for a while; then none."""
        if self._quiet:
            self._later(QUIET_S, 2 * QUIET_S, self.change_policy)
            return
        self.happened["change_policy"] += 1
        self._set_policy(self.rng.choice(POLICIES[1:]))
        self._later(300.0, 900.0, self._end_policy)

    def _end_policy(self) -> None:
        if self._quiet:
            self._later(QUIET_S, 2 * QUIET_S, self._end_policy)
        else:
            self._set_policy(None)

    def _set_policy(self, policy: Policy | None) -> None:
        self.checker.policy_at = self.timeline.now
        self.plane.set_policy(policy)

    def outage(self) -> None:
        """Cut the network in front of the control plane for a minute: all streams die at once, silently."""
        if self._quiet:
            self._later(QUIET_S, 2 * QUIET_S, self.outage)
            return
        self.happened["outage"] += 1
        members = self._alive()
        for member in members:
            member.network_down = True
            member.break_line(half_open=True)

        def over() -> None:
            for member in members:
                member.network_down = False

        self._later(*SPELL_S, over)

    # ── the day ──

    def begin(self) -> None:
        """Start the control plane and the fleet, and draw the times of events that concern all."""
        self.plane.start()
        for number in range(self.scale.members):
            role = Role.CLOUD if number < self.clouds_wanted else Role.ROBOT
            self._later(0.0, 60.0, partial(self._join, role))
        length_s = self.scale.hours * HOUR_S
        spread = self.scale.restarts
        for kind, count, last in (
            (self.restart_plane, spread, RESTARTS_UNTIL),
            (self.change_policy, spread, 1.0),
            (self.outage, spread // 2, 1.0),
        ):
            for _ in range(count):
                self.timeline.at(START + self.rng.uniform(0.02, last) * length_s, kind)
        self.timeline.after(300.0 if self.scale.hours > 2.0 else 100.0, self._moment)
        self.timeline.after(self.scale.look_s, self._look)
        self._busy()

    def _moment(self) -> None:
        if not self._quiet:
            for _ in range(self.rng.randint(1, self.scale.events)):
                if not (self._alive(Role.ROBOT) and self._alive(Role.CLOUD)):
                    break
                kind = self.rng.choices(self._kinds, self._weights)[0]
                self.happened[kind.__name__] += 1
                kind()
        self._later(0.0, 2 * self.scale.moment_s, self._moment)

    def _look(self) -> None:
        self.checker.look(self.timeline.now)
        if self.plane.up:
            self._operator_looks()
        self.timeline.after(self.scale.look_s, self._look)

    def _operator_looks(self) -> None:
        core, now = self.plane.core, self.timeline.now
        names = [*(sidecar.name for sidecar in core.registry), *(gone.name for gone in core.departed)]
        for name in self.rng.sample(names, min(3, len(names))):
            core.view(name, now)
            member = self.members.get(name)
            known = core.registry.get(name)
            if member is not None and known is not None and known.uses:
                core.explain(name, known.uses[0].name, now)

    def _busy(self) -> None:
        """Vary the load of the control plane's processor: more by day than by night, and too much for some minutes."""
        hour = (self.timeline.now - START) / HOUR_S
        self.plane.busy = 0.3 - 0.25 * math.cos(hour / 24.0 * 2 * math.pi) + (0.4 if self.rng.random() < 0.2 else 0.0)
        self.timeline.after(300.0, self._busy)

    def run(self) -> None:
        """Run the whole day, with a measurement at the end of each part."""
        self.begin()
        parts = round(self.scale.hours / self.scale.every_hours)
        for part in range(1, parts + 1):
            ends = START + part * self.scale.every_hours * HOUR_S
            self.timeline.run(ends - QUIET_S)
            self._quiet = True
            self.timeline.run(ends)
            self._quiet = False
            self._sample()
        self._quiet = True
        self.plane.stop(orderly=False)
        self.timeline.after(2.0, self.plane.start)
        self.timeline.run(self.timeline.now + QUIET_S)
        self.judged_at_last = self.checker.look(self.timeline.now)

    def grown(self) -> list[str]:
        """Return the tables that grew over time in the control plane that ran longest."""
        run = self.plane.starts - 1
        sizes = [sample.sizes for sample in self.samples if sample.run == run]
        return grown(sizes, share=GROWTH_SHARE, slack=self.scale.slack, capped=CAPPED)

    @property
    def last_members(self) -> int:
        """Number of sidecars present at the end."""
        return len(self._alive())

    def _sample(self) -> None:
        now = self.timeline.now
        judged = self.checker.look(now)
        events = self.plane.events
        assert events is not None
        sample = Sample(
            at_h=(now - START) / HOUR_S,
            run=self.plane.starts,
            registered=len(self.plane.core.registry),
            judged=judged,
            sizes=measure(self.plane.core),
            sidecars=measure(_Sidecars([member.session for member in self.members.values() if member.session])),
            events_kept=len(events.events()),
            log_bytes=sum(path.stat().st_size for path in self._folder.iterdir()),
        )
        self.samples.append(sample)
        self.on_sample(sample)

    def healthy(self) -> int:
        """Return how many sidecars have no reason to lag."""
        return sum(is_healthy(member, self.timeline.now) for member in self.members.values())


class _Sidecars:
    def __init__(self, sessions: Iterable[object]) -> None:
        self.sessions = list(sessions)
