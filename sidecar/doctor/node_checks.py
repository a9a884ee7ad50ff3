"""Judges what a node shows without its sidecar: certificate, clock, ROS, interfaces. Pure: all input is passed in."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from plr.protos.program.certificate_term import term_problem
from plr.protos.trust.clock_floor import SLACK_S
from plr.sidecar.doctor.finding import duration, fail, ok, warn
from plr.sidecar.ros import shared_memory
from plr.sidecar.ros.environment import LAST_SECOND, SET_CLOCK, clock_problem
from plr.sidecar.ros.static_peers import told

if TYPE_CHECKING:
    from collections.abc import Container, Iterable, Iterator, Mapping

    from plr.protos.program.tls_files import TlsFiles
    from plr.protos.trust.identity import Identity
    from plr.sidecar.doctor.finding import Finding
    from plr.sidecar.doctor.host import ClockState
    from plr.sidecar.net.interfaces import InterfaceChoice

SECONDS_PER_DAY = 86_400.0
STRICT = 1
SEE_ROUTES = "see docs/start/install.md, More than one interface"


def certificate(files: TlsFiles, now_wall: float) -> Iterator[Finding]:
    """Judge a node's certificate files at `now_wall` (s since 1970)."""
    identity = files.identity
    problem = term_problem(files, now_wall)
    if problem is not None:
        text, _, remedy = problem.text.partition("; ")
        yield (warn if problem.in_force else fail)("certificate", text, remedy or "see docs/start/certificates.md")
    else:
        lists = [one for one in files.trust.lists().values() if one is not None]
        held = ", ".join(f"number {one.number}, signed {duration(now_wall - one.signed_at)} ago" for one in lists)
        revoked = f"not revoked by the list in use ({held})" if lists else "no revocation list is in use"
        yield ok("certificate", f"{_who(identity)}, {_left(identity, now_wall)}, {revoked}")


def files_on_disk(files: TlsFiles | None, broken: str | None, used: Mapping[str, Any]) -> Iterator[Finding]:
    """Judge whether the files on disk are those that a running sidecar reports in `used`.

    `broken` says why they cannot be read. If both are None, this user may not read them, and the sidecar's word counts.
    """
    refused = used.get("refused")
    if broken is None and refused:
        # Perhaps only the sidecar refuses them: they may be readable for other users than its own.
        text, _, remedy = str(refused.get("text")).partition("; ")
        if refused.get("start"):
            yield warn("certificate", f"{text}; the sidecar continues with the files that it has", remedy)
            return
        broken = str(refused.get("text"))
    if broken is not None:
        text, _, remedy = broken.partition("; ")
        after = "the sidecar continues with the files that it read before, and its next start fails"
        yield fail(
            "certificate",
            f"{text}; {after}",
            remedy.removeprefix("do: ").removeprefix("see: ")
            or "copy the files that plr ca issue or plr ca renew wrote to that folder",
        )
    elif files is not None and used.get("serial") not in (None, f"{files.identity.serial:x}"):
        yield warn(
            "certificate",
            f"{files.directory} holds another certificate than the one that the sidecar uses",
            "the sidecar checks every second: try again; if this stays so, its log says why: journalctl -u plr-sidecar",
        )


def certificate_in_use(used: Mapping[str, Any], now_wall: float) -> Iterator[Finding]:
    """Judge the certificate that a running sidecar reports, where this user may not read its files."""
    problem = used.get("problem")
    if problem:
        text, _, remedy = str(problem.get("text")).partition("; ")
        yield (warn if problem.get("in_force") else fail)(
            "certificate", text, remedy or "see docs/start/certificates.md"
        )
        return
    lists = used.get("revocation_lists") or ()
    held = ", ".join(f"number {one['number']}, signed {duration(now_wall - one['signed_at'])} ago" for one in lists)
    revoked = f"not revoked by the list in use ({held})" if lists else "no revocation list is in use"
    days = (used["not_after"] - now_wall) / SECONDS_PER_DAY
    yield ok("certificate", f"{used['name']}, {used['role']}, {days:.0f} days left, {revoked}")


def _who(identity: Identity) -> str:
    return f"{identity.name}, {identity.role.value}"


def _left(identity: Identity, now_wall: float) -> str:
    return f"{(identity.not_after - now_wall) / SECONDS_PER_DAY:.0f} days left"


def clock(now_wall: float, floor: float, state: ClockState | None) -> Iterator[Finding]:
    """Judge the host's clock by the newest time that the CA has signed (`floor`; 0: none known) and by NTP."""
    set_it = SET_CLOCK
    if now_wall >= LAST_SECOND:
        yield fail("clock", clock_problem(now_wall).partition("; ")[0], set_it)
        return
    if now_wall < floor - SLACK_S:
        yield fail(
            "clock", f"at least {duration(floor - now_wall)} behind the newest time that the CA has signed", set_it
        )
        return
    if state is None:
        yield ok("clock", "not behind the newest time that the CA has signed; whether NTP keeps it is unknown")
    elif not state.synchronised:
        yield warn(
            "clock",
            "not behind the newest time that the CA has signed, but not synchronised, as the kernel reports",
            "run an NTP client: timedatectl set-ntp true, or apt install chrony",
        )
    else:
        yield ok("clock", f"kept by NTP, wrong by {state.error_s * 1000:.0f} ms at most")


def ros(
    environment: Mapping[str, str],
    shell: Mapping[str, str],
    problem: str | None,
    *,
    of_unit: bool = False,
    user: int | None = None,
    others: frozenset[int] = frozenset(),
) -> Iterator[Finding]:
    """Judge ROS by the sidecar's `environment`; `problem` is what `plr.sidecar.ros.environment` found.

    `of_unit`: whether a unit sets it. `user` runs the sidecar, and `others` run programs in its ROS domain.
    """
    if problem is not None:
        remedy = (
            "correct the environment of the unit (/etc/plr/sidecar.env) or of this shell: docs/start/install.md, "
            "ROS on the host"
        )
        if problem.endswith(SET_CLOCK):
            problem, remedy = problem.removesuffix(f"; {SET_CLOCK}"), SET_CLOCK
        yield fail("ros", problem, remedy)
    else:
        yield ok(
            "ros", f"rclpy works, with {environment.get('RMW_IMPLEMENTATION') or 'rmw_fastrtps_cpp (the default)'}"
        )
    yield _domain(environment, shell, of_unit, user, others)


def _domain(
    environment: Mapping[str, str], shell: Mapping[str, str], of_unit: bool, user: int | None, others: frozenset[int]
) -> Finding:
    domain, here = (env.get("ROS_DOMAIN_ID") or "0" for env in (environment, shell))
    note = "" if domain == here else f" (this shell: {here}; programs started in it do not see the sidecar)"
    reach, profile = shared_memory.discovery_range(environment), shared_memory.profile(environment)
    text = f"ROS_DOMAIN_ID {domain}{note}, discovery {reach}"
    if reach == "OFF":
        remedy = "remove ROS_AUTOMATIC_DISCOVERY_RANGE from /etc/plr/sidecar.env, or set LOCALHOST in this shell"
        return fail("domain", f"{text}: ROS finds no other program, so no call is answered", remedy)
    apart = None if user is None else shared_memory.problem(environment, user, others)
    if apart is not None:
        return (fail if others - {user} else warn)("domain", f"{text}: {apart}", shared_memory.REMEDY)
    if reach == "LOCALHOST":
        return ok("domain", text)
    if profile and reach == "SYSTEM_DEFAULT":
        return ok("domain", f"{text}, by {profile}")
    remedy = (
        "remove ROS_AUTOMATIC_DISCOVERY_RANGE from /etc/plr/sidecar.env, because the unit brings a DDS profile"
        if of_unit and shared_memory.is_fast_dds(environment)
        else "set ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST for the sidecar: docs/start/install.md, ROS on the host"
    )
    return warn("domain", f"{text}: ROS uses every network and bypasses the sidecar", remedy)


def static_peers(left_out: Iterable[str]) -> Iterator[Finding]:
    """Report hosts of ROS_STATIC_PEERS without an address, which the sidecar leaves out."""
    if names := tuple(left_out):
        text, _, remedy = told(names).partition("; ")
        yield warn("ros", text, remedy)


def types(wanted: Mapping[str, str], missing: Mapping[str, str]) -> Iterator[Finding]:
    """Judge the types of services by name; `missing` holds those that this environment lacks."""
    for name, kind in sorted(missing.items()):
        package = kind.partition("/")[0]
        yield fail(
            "types",
            f"{name}: its type {kind} is not installed in the sidecar's environment",
            f"apt install ros-jazzy-{package.replace('_', '-')}, or add its workspace to /etc/plr/sidecar.env",
        )
    there = [f"{name} ({kind})" for name, kind in sorted(wanted.items()) if name not in missing]
    if there:
        yield ok("types", f"installed: {', '.join(there)}")


def interfaces(
    choice: InterfaceChoice, used: Container[str] | None = None, unopened: Container[str] = ()
) -> Iterator[Finding]:
    """Compare the configured interfaces with those that exist, and with those that a running sidecar has `used`.

    Those in `unopened` are reported elsewhere: the sidecar could not open their sockets.
    """
    for one in choice.usable:
        if one.name in unopened:
            continue
        if used is not None and one.name not in used:
            yield warn(
                "interface",
                f"{one.name}: it could carry data, but the running sidecar does not use it",
                "restart the sidecar if its configuration changed; its log says more: journalctl -u plr-sidecar",
            )
            continue
        routed = sorted({family for family, _ in one.gateways})
        routes = "default route over " + " and ".join(f"IPv{family}" for family in routed) if routed else ""
        yield ok(
            "interface",
            f"{one.name}: carrier, {', '.join(one.addresses)}, MTU {one.mtu}, {routes or 'no default route'}",
        )
        if not routed and one.kind != "loopback" and len(choice.usable) > 1:
            yield warn(
                "interface",
                f"{one.name}: no default route uses it, so it reaches only its own subnet",
                f"add one with a metric of its own; {SEE_ROUTES}",
            )
    cures = {
        "down": "ip link set {} up",
        "no carrier": "check cable, SIM and access point: nmcli device, mmcli -m any",
        "no address": "DHCP: nmcli device reapply {}, or networkctl renew {}",
    }
    for skipped in choice.skipped:
        if skipped.wanted:
            cure = cures.get(skipped.reason, "see docs/operate/troubleshooting.md").replace("{}", skipped.name)
            yield warn("interface", f"{skipped.name}: {skipped.reason}; it carries nothing now", cure)
    for name in choice.missing:
        yield warn(
            "interface",
            f"{name}: configured, but not present",
            "plug it in, or correct `interfaces` (ip link lists them)",
        )
    if not choice.usable:
        there = ", ".join(f"{skipped.name} ({skipped.reason})" for skipped in choice.skipped) or "none"
        yield fail(
            "interface", f"no interface can carry data; present: {there}", "bring one up, or name one in `interfaces`"
        )


def reverse_path(filters: Mapping[str, int | None]) -> Iterator[Finding]:
    """Judge the `rp_filter` in force on each interface in use."""
    strict = sorted(name for name, value in filters.items() if value == STRICT)
    if strict and len(filters) > 1:
        yield warn(
            "rp_filter",
            f"strict on {', '.join(strict)}: answers that do not arrive over the best route back are lost",
            f"sysctl -w {' '.join(f'net.ipv4.conf.{name}.rp_filter=2' for name in ('all', *strict))}; {SEE_ROUTES}",
        )
        return
    names = {None: "unknown", 0: "off", 1: "strict", 2: "loose"}
    shown = ", ".join(f"{name} {names.get(value, value)}" for name, value in sorted(filters.items()))
    if shown:
        yield ok("rp_filter", shown + (" (harmless with one interface)" if strict else ""))


def running_environment(node: Mapping[str, Any], shell: Mapping[str, str]) -> dict[str, str]:
    """Return the environment of the running sidecar as it reports it, or else that of this shell."""
    told = node.get("environment")
    return {str(key): str(value) for key, value in told.items()} if isinstance(told, dict) else dict(shell)
