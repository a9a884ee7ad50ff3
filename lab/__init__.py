"""Builds a network laboratory on one machine from network namespaces.

     robot                                                         internet
    ┌───────────┐  emulated link   ┌────────────────┐              ┌──────┐      ┌─────────┐
    │     wlan0 ├~~~~~~~~~~~~~~~~~~┤ lan0  NAT wan0 ├──────────────┤      ├──eth0┤ cloud_a │
    │ .1.2      │ delay loss rate  │ .1.1      .1.2 │ 198.18.1.0/24│      │      └─────────┘
    │           │  192.168.1.0/24  └────────────────┘              │ core │      ┌─────────┐
    │           │                  ┌────────────────┐              │router├──eth0┤ cloud_b │
    │     wwan0 ├~~~~~~~~~~~~~~~~~~┤ lan0  NAT wan0 ├──────────────┤      │      └─────────┘
    │ .2.2      │  192.168.2.0/24  │ .2.1      .2.2 │ 198.18.2.0/24│      │      ┌─────────┐
    └───────────┘                  └────────────────┘              │      ├──eth0┤ control │
                                                                   └──────┘      └─────────┘

Every box is a set of namespaces of its own (network, mount, host name, IPC), with its own /dev/shm and
/etc/hosts; file system, users and working directory are the caller's. IPv4 and IPv6 work throughout; the
routers translate IPv4 and filter both. Each `~~~` is a process (`lab.emulator`) that carries
the frames between two TAP devices through a seeded `LinkModel`.

    from lab import Lab, LabConfig, LinkProfile, load_trace

    with Lab(LabConfig.of(interfaces=("wlan0", "wwan0"), clouds=2), seed=1) as lab:
        robot, cloud = lab.host("robot"), lab.host("cloud_a")
        cloud.address()                         # "198.18.3.2"; address("eth0", family=6)
        server = cloud.popen([...], log_path="cloud.log")   # a subprocess.Popen; signals reach the program
        robot.run(["ping", "-c1", "cloud_a"], check=True)   # a CompletedProcess[str]
        robot.socket(device="wwan0")            # a UDP socket of the robot in this very process
        cloud.kill(server)                      # SIGKILL and wait

        wlan = lab.link("wlan0")                # up: robot to internet, down: back
        wlan.set(LinkProfile(delay_ms=20, jitter_ms=5, loss=0.01, rate_kbps=20_000))
        wlan.set(down=LinkProfile(delay_ms=60)) # one direction only
        wlan.change(loss=0.2)                   # single fields, both directions
        wlan.outage()                           # rate 0: the queue fills, then drops
        wlan.blackhole()                        # all is lost, the carrier stays up
        wlan.unplug()                           # all is lost, the carrier goes
        wlan.restore()                          # end of blackhole or unplug
        lab.replay(load_trace("drive.csv.gz"), {"wlan0": "a", "wwan0": "b"})   # one clock
        wlan.stats()                            # counters, drops by reason, how late its timers ran
        wlan.reset()

        robot.link_down("wlan0"); robot.link_up("wlan0")    # ip link set wlan0 down / up
        lab.nat("wwan0").rebind()               # the carrier forgets its mappings: new ports

Needs Linux, iproute2, nftables, util-linux; root, or an ordinary user who may make user namespaces.
When the `with` block ends, or the process that made the lab dies in any way, the kernel takes down the
lab's PID namespace: no process, namespace, interface or rule is left. Programs are killed then, not
asked to stop; stop them before if they must end cleanly.

A host has a default route for each interface, with metrics 100, 200, ... in the order of the interfaces,
and no reverse path filter: a socket bound to a device (SO_BINDTODEVICE) leaves through it.
`python -m lab --help` opens a lab to look around in.
"""

from __future__ import annotations

from lab.errors import LabConfigError, LabError
from lab.host import Host, HostProcess
from lab.lab import Lab, Nat
from lab.link import DirectionStats, Lateness, Link, LinkStats
from lab.profile import DropReason, LinkProfile
from lab.topology import HostSpec, InterfaceSpec, LabConfig, NatSpec, robot, server
from lab.traces import Trace, TraceStep, load_trace, parse_trace

__all__ = [
    "DirectionStats",
    "DropReason",
    "Host",
    "HostProcess",
    "HostSpec",
    "InterfaceSpec",
    "Lab",
    "LabConfig",
    "LabConfigError",
    "LabError",
    "Lateness",
    "Link",
    "LinkProfile",
    "LinkStats",
    "Nat",
    "NatSpec",
    "Trace",
    "TraceStep",
    "load_trace",
    "parse_trace",
    "robot",
    "server",
]
