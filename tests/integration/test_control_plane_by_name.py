"""`plr` finds a control plane by its name in /etc/hosts, whatever the name servers do."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

SILENT = "192.0.2.53"
"""Everything that is sent there is lost: a host that is off, or a firewall that drops."""

SCRIPT = """
set -e
ip link set lo up
ip link add silent type veth peer name far
ip link set far up
ip addr add 192.0.2.1/24 dev silent
ip link set silent up
ip neigh add {silent} lladdr 02:00:00:00:00:01 dev silent nud permanent
mount --bind {folder}/hosts /etc/hosts
mount --bind {folder}/resolv.conf "$(readlink -f /etc/resolv.conf)"
cd {root}
exec {python} -c "from plr.protos.program.entry import plr; raise SystemExit(plr())" \\
  status --insecure --address {address} --timeout-s {timeout_s}
"""


def status(folder: Path, address: str, timeout_s: float) -> subprocess.CompletedProcess[str]:
    """`plr status` on a host whose only name server is silent."""
    (folder / "hosts").write_text("127.0.0.1 localhost control.test\n")
    (folder / "resolv.conf").write_text(f"nameserver {SILENT}\n")
    script = SCRIPT.format(
        silent=SILENT,
        folder=folder,
        root=Path(__file__).parents[2],
        python=sys.executable,
        address=address,
        timeout_s=timeout_s,
    )
    return subprocess.run(
        ["unshare", "--net", "--mount", "bash", "-c", script], capture_output=True, text=True, timeout=60, check=False
    )


pytestmark = [
    pytest.mark.skipif(os.geteuid() != 0, reason="namespaces take root"),
    pytest.mark.audit("ops-7"),
]


def test_a_silent_name_server_does_not_hide_what_stands_in_etc_hosts(tmp_path: Path) -> None:
    done = status(tmp_path, "control.test:50051", 8)
    assert done.returncode == 1
    assert done.stderr.startswith("plr: control.test:50051: nothing listens on this TCP port")


def test_a_host_that_does_not_answer_is_told_with_what_to_do(tmp_path: Path) -> None:
    done = status(tmp_path, f"{SILENT}:50051", 0.5)
    assert done.returncode == 1
    assert done.stderr.startswith(f"plr: {SILENT}:50051: no answer within 0.5 s: check that")
    assert done.stderr.count("\n") == 1
