from __future__ import annotations

import errno
import functools
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.netns

PROBE = Path(__file__).with_name("socket_probe.py")
ROOT = PROBE.parents[2]
LINKS = {"wlan0": ("10.0.1.1", "fd00:1::1"), "wwan0": ("10.0.2.1", "fd00:2::1")}


@functools.cache
def probe(scenario: str, *, wrapper: tuple[str, ...] = ()) -> tuple[dict[str, Any], str]:
    """Return what the scenario of socket_probe.py saw, and its log."""
    unshare = ["unshare", "--net", "--fork", "--kill-child"]
    if os.geteuid() != 0:
        unshare.append("--map-root-user")
    argv = [*unshare, *wrapper, sys.executable, str(PROBE), scenario]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(argv, capture_output=True, text=True, timeout=60, env=environment)
    assert done.returncode == 0, done.stderr
    seen: dict[str, Any] = json.loads(done.stdout)
    return seen, done.stderr


def test_each_socket_keeps_to_its_device_in_both_families() -> None:
    seen, log = probe("sockets")
    for name, (source4, source6) in LINKS.items():
        assert seen[name]["bound_to"] == "device"
        assert seen[name]["family"] == "AF_INET6"
        assert seen[name]["source4"] == source4
        assert seen[name]["source6"] == source6
        assert not seen[name]["blocking"]
    assert "CAP_NET_RAW" not in log


def test_buffers_are_as_large_as_wanted_and_the_kernel_allows() -> None:
    # Doubled by the kernel; without CAP_NET_ADMIN over the machine (user namespaces) net.core's limits hold.
    limits = [int(Path(f"/proc/sys/net/core/{name}_max").read_text()) for name in ("rmem", "wmem")]
    seen, _ = probe("sockets")
    for link in seen.values():
        assert link["receive_buffer"] >= 2 * min(4 << 20, limits[0])
        assert link["send_buffer"] == 2 * min(512 << 10, limits[1])


def test_sockets_of_several_interfaces_may_share_a_port() -> None:
    seen, _ = probe("same_port")
    assert {link["port"] for link in seen.values()} == {47001}
    assert [link["source4"] for link in seen.values()] == ["10.0.1.1", "10.0.2.1"]


def test_without_permission_the_address_holds_the_socket_on_its_interface() -> None:
    seen, log = probe("no_capability")
    for name, (source4, _) in LINKS.items():
        assert seen[name]["bound_to"] == "address"
        assert seen[name]["source4"] == source4
        assert log.count(f"{name}: not allowed to bind to the device") == 1


def test_on_a_kernel_without_ipv6_the_socket_is_ipv4() -> None:
    seen, _ = probe("no_ipv6")
    for name, (source4, _) in LINKS.items():
        assert seen[name]["bound_to"] == "device"
        assert seen[name]["family"] == "AF_INET"
        assert seen[name]["source4"] == source4
        assert seen[name]["source6"] is None


def test_a_taken_port_is_an_error() -> None:
    seen, _ = probe("taken_port")
    assert seen["error"] == errno.EADDRINUSE


def test_datagrams_are_not_fragmented() -> None:
    seen, _ = probe("too_long")
    assert seen == {"4": errno.EMSGSIZE, "6": errno.EMSGSIZE}


def test_runs_are_cut_by_the_kernel_and_what_is_too_long_in_them_is_reported() -> None:
    if shutil.which("ethtool") is None:
        pytest.skip("ethtool is not installed")
    seen, log = probe("runs")
    assert len(seen) == 4
    for outcome in seen.values():
        # Ten that fit, and of the next ten the last one.
        assert outcome["answered"] == 11
        assert outcome["dropped"] == {"unsendable_emsgsize": 9}
        assert outcome["told"] == [1]
    assert seen["4 on"]["segments"]
    # Without checksum offload some kernels refuse; then, and only then, datagrams go one by one.
    assert all(outcome["segments"] for outcome in seen.values()) == ("does not segment datagrams" not in log)


def test_a_dropped_capability_costs_nothing_on_kernels_that_do_not_ask_for_it() -> None:
    if os.geteuid() != 0:
        pytest.skip("dropping a capability takes root")
    seen, log = probe("sockets", wrapper=("setpriv", "--bounding-set=-net_raw", "--inh-caps=-net_raw"))
    release = tuple(int(part) for part in os.uname().release.split(".")[:2])
    bound_to = "device" if release >= (5, 7) else "address"
    assert [link["bound_to"] for link in seen.values()] == [bound_to] * 2
    assert ("CAP_NET_RAW" in log) == (bound_to == "address")
    assert [link["source4"] for link in seen.values()] == ["10.0.1.1", "10.0.2.1"]


def test_interfaces_are_described_as_netlink_has_them() -> None:
    seen, _ = probe("interfaces")
    assert seen["lo"]["kind"] == "loopback"
    assert seen["wlan0"]["kind"] == "veth"
    assert seen["wlan0"]["up"]
    assert seen["wlan0"]["carrier"]
    assert seen["wlan0"]["gateways"]
    # No link-local ones, and of a point-to-point address our end.
    assert sorted(seen["wlan0"]["addresses"]) == ["10.0.1.1", "10.0.8.1", "fd00:1::1"]
    assert seen["br-lab"]["kind"] == "bridge"
    assert not seen["br-lab"]["up"]
    assert not seen["eth7"]["up"]
    assert seen["eth6"]["up"]
    assert not seen["eth6"]["carrier"]
    assert seen["eth6"]["addresses"] == ["10.0.6.1"]
    assert seen["eth6"]["gateways"] == []
