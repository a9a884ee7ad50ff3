"""Runs a member of the fleet with a valid certificate, whose program was changed to attempt every attack at once.

`python -m lab.attacker.insider --config FILE.yaml` replaces a robot's or cloud's sidecar. It is honest until
FILE.orders says otherwise (`orders`), and counts its attacks in FILE.tally. It uses only processor time that nobody
else wants (SCHED_IDLE): a real insider has a machine of its own, so only the cost that it causes at the others counts.
"""

from __future__ import annotations

import contextlib
import os
import random
import sys
import threading
import time
from pathlib import Path
from typing import Any

import yaml
from plr_demo_interfaces.srv import DetectPeople
from rclpy.serialization import serialize_message

from lab.attacker.bombs import MB, bomb, garbage
from lab.attacker.hostile_control import HostileControl
from lab.attacker.hostile_link import ESCAPES, LARGE_ANSWER, HostileLink
from lab.attacker.hostile_means import Means
from lab.attacker.orders import ORDERS, TALLY, Commander, Stage
from lab.attacker.tally import Tally
from plr.protos.model.ids import ServiceName
from plr.protos.program.tls_files import load_tls_files
from plr.sidecar import __main__ as sidecar
from plr.sidecar import runtime
from plr.sidecar.core.base.values import RejectReason, RequestId
from plr.sidecar.core.cloud.cloud_role import CloudRole
from plr.sidecar.net import managed_interface
from plr.sidecar.net.dataplane import ThreadedDataPlane

SERVICE = ("/echo", "plr_demo_interfaces/srv/DetectPeople")
BAD_ANSWERS = 0.1
"""Share of answers that are invalid."""
BOMBS = 0.1
"""Share of the invalid answers that are large."""
LARGE_BYTES = 100_000
TURN_S = 0.5
BOMB_TURNS = 4
CLOUDS_CYCLE = 1.3
"""Ratio of a cloud's cycle to a robot's."""
_CLOSE_FROM = 3


def idle() -> None:
    """Use only processor time that nobody else wants, in all future threads."""
    os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))


def main() -> int:
    """Run the sidecar's command line."""
    idle()
    config_file = Path(sys.argv[sys.argv.index("--config") + 1])
    config = yaml.safe_load(config_file.read_text())
    means = _means(config_file, config)
    HostileLink.means = HostileControl.means = means
    # The changes to the program.
    change(managed_interface, "Link", HostileLink)
    change(runtime, "ControlSession", HostileControl)
    if config["role"] == "cloud":
        _answer_badly(means)
    else:
        _ask_much(means)
    threading.Thread(target=_follow_cycle, args=(means,), name="cycle", daemon=True).start()
    return sidecar.main()


def change(where: Any, name: str, to: Any) -> None:
    """Replace what the program knows by this name."""
    assert hasattr(where, name), f"{name} is elsewhere by now"
    setattr(where, name, to)


def _means(config_file: Path, config: dict[str, Any]) -> Means:
    request = DetectPeople.Request()
    request.image.data = bytes(32)
    of_much = DetectPeople.Request()
    of_much.image.format = LARGE_ANSWER
    large = DetectPeople.Request()
    large.image.data = bytes(LARGE_BYTES)
    response = DetectPeople.Response(message="." * 32)
    return Means(
        Commander(config_file.with_suffix(ORDERS), CLOUDS_CYCLE if config["role"] == "cloud" else 1.0),
        Tally(config_file.with_suffix(TALLY)),
        load_tls_files(Path(config["tls_dir"])).private_key,
        SERVICE,
        *(serialize_message(message) for message in (request, of_much, large, response)),
    )


def _follow_cycle(means: Means) -> None:
    """Restart at the end of a cycle, like a restarted sidecar: its peers do not talk to earlier sessions."""
    while True:
        time.sleep(TURN_S)
        means.tally.write()
        if means.commander.stage is Stage.OVER:
            means.tally.add("restarts of the program")
            means.tally.write()
            for number in map(int, os.listdir("/proc/self/fd")):
                if number >= _CLOSE_FROM:
                    with contextlib.suppress(OSError):  # it belonged to this listing, or is closed by now
                        os.set_inheritable(number, False)
            os.execv(sys.executable, [sys.executable, "-m", "lab.attacker.insider", *sys.argv[1:]])


def _answer_badly(means: Means) -> None:
    honest = CloudRole.complete
    rng = random.Random(1)

    def complete(cloud: CloudRole, execution: Any, payload: bytes, processing_s: float, now: float) -> None:
        if means.commander.stage is not Stage.HONEST:
            processing_s = 0.0
            if rng.random() < BAD_ANSWERS and _answer(cloud, execution, now):
                return
        honest(cloud, execution, payload, processing_s, now)

    def _answer(cloud: CloudRole, execution: Any, now: float) -> bool:
        kind = rng.random()
        if kind < 0.2:
            what, bad = "refusals with escape sequences", b""
        elif kind < 0.2 + BOMBS:
            what, bad = "answers that are CDR bombs", bomb(means.response, rng.choice((MB, MB, MB, 16 * MB)), rng)
        else:
            what, bad = "garbage in place of answers", garbage(means.response, rng)
        if not means.commander.want(what):
            return False
        means.tally.add(what, 1, len(bad))
        if bad:
            honest(cloud, execution, bad, 0.0, now)
        else:
            cloud.refuse(execution, RejectReason.OVERLOADED, ESCAPES, now)
        return True

    change(CloudRole, "complete", complete)


def _ask_much(means: Means) -> None:
    class Asking(ThreadedDataPlane):
        def start(self) -> None:
            super().start()
            threading.Thread(target=self._ask, name="asking", daemon=True).start()

        def _ask(self) -> None:
            rng = random.Random(1)
            turn = 0
            while True:
                time.sleep(TURN_S)
                if means.commander.stage is not Stage.STEADY:
                    continue
                turn += 1
                what, payload = "large requests", means.request_that_is_large
                if turn % BOMB_TURNS == 0:
                    size = 16 * MB if turn % (8 * BOMB_TURNS) == 0 else MB
                    what, payload = "requests that are CDR bombs", bomb(means.request, size, rng)
                if not means.commander.want(what):
                    continue
                means.tally.add(what, 1, len(payload))
                self.submit(RequestId(rng.randbytes(16)), ServiceName(SERVICE[0]), payload)

    change(runtime, "ThreadedDataPlane", Asking)


if __name__ == "__main__":
    sys.exit(main())
