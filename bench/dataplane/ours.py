"""Starts our data plane for a section: programs of a robot and some clouds, introduced to each other, ready to call."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Any, Self

from bench.dataplane.calling import HEADER
from bench.dataplane.remote import Remote
from bench.dataplane.statistics import Calls
from bench.dataplane.topology import CARRIERS, CLOUD, CLOUD_INTERFACE, ROBOT

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path
    from types import TracebackType

    from lab import Host, Lab

Service = dict[str, Any]
SERVICE: Service = {"name": "/bench", "deadline_ms": 1_000.0, "lifetime_ms": 30_000.0, "idempotent": True}


EVERY_CARRIER = [(carrier, CLOUD) for carrier in CARRIERS]
"""A mapping that sends each request over all carriers."""


class Ours:
    """Robot and clouds. Use it in a `with` block."""

    def __init__(
        self,
        folder: Path,
        *,
        robot: Host | None = None,
        clouds: Mapping[str, Host | None],
        interfaces: Sequence[str] = ("lo",),
        cloud_interface: str = "lo",
        mapping: Sequence[tuple[str, str]] | None = None,
        service: Service = SERVICE,
        answer_bytes: int = HEADER.size,
        name: str = "ours",
        null_cipher: bool = False,
        rekey_after_s: int | None = None,
        before: Sequence[str] = (),
    ) -> None:
        """Start the programs; hosts are the lab's, None is this machine. Without `mapping` the engine picks the paths.

        With `null_cipher` nothing is sealed. `rekey_after_s` is that of a sidecar's configuration. `before` is a
        command that starts each program, such as chrt.
        """
        self._stack = contextlib.ExitStack()
        start = self._stack.enter_context
        try:
            self.clouds = {
                cloud: start(Remote.start("engine", folder, host=host, name=f"{name}.{cloud}", before=before))
                for cloud, host in clouds.items()
            }
            self.robot = start(Remote.start("engine", folder, host=robot, name=f"{name}.robot", before=before))
            seal = {"null_cipher": null_cipher}
            common: dict[str, Any] = {"stun": {"enabled": False}, "udp_port": 0, "log_level": "warning"}
            if rekey_after_s is not None:
                common["rekey_after_s"] = rekey_after_s
            self._peers: list[Any] = []
            for cloud, program in self.clouds.items():
                config = {"name": cloud, "role": "cloud", "interfaces": [cloud_interface], **common}
                services = [{key: service[key] for key in ("name", "fec") if key in service}]
                self._peers.append(
                    program.ask("start", config={**config, "services": services}, answer_bytes=answer_bytes, **seal)
                )
            config = {"name": "robot", "role": "robot", "interfaces": list(interfaces), **common}
            me = self.robot.ask("start", config={**config, "services": [service]}, **seal)
            for program in self.clouds.values():
                program.ask("meet", peers=[me])
            self.map_to(mapping)
            self.robot.ask("wait_until_offered")
        except BaseException:
            self._stack.close()
            raise

    @classmethod
    def in_lab(
        cls,
        lab: Lab,
        folder: Path,
        *,
        clouds: Sequence[str] = (CLOUD,),
        mapping: Sequence[tuple[str, str]] | None = EVERY_CARRIER,
        **more: Any,
    ) -> Self:
        """Start them in a lab of `topology`, the robot with the carriers of its mapping; `more` as above."""
        carriers = CARRIERS if mapping is None else tuple(dict.fromkeys(carrier for carrier, _ in mapping))
        hosts = {cloud: lab.host(cloud) for cloud in clouds}
        more = {"interfaces": carriers, "cloud_interface": CLOUD_INTERFACE, **more}
        return cls(folder, robot=lab.host(ROBOT), clouds=hosts, mapping=mapping, **more)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def map_to(self, mapping: Sequence[tuple[str, str]] | None) -> None:
        """Send every request over these (interface, cloud) pairs from now on."""
        self.robot.ask("meet", peers=self._peers, mapping=mapping)

    def call(self, **plan: Any) -> Calls:
        """Send the requests of a `calling.Plan` and wait for the answers."""
        self.begin(**plan)
        return self.finish()

    def begin(self, **plan: Any) -> None:
        """Begin to send; `finish` returns the outcome."""
        self.robot.begin("call", **plan)

    def finish(self, timeout_s: float = 180.0) -> Calls:
        """Wait for the outcome of what was begun."""
        return Calls.of(self.robot.finish(timeout_s))

    def take_one_way(self) -> list[float]:
        """Return the one-way seconds of the requests since the last call, over all clouds."""
        return [seconds for cloud in self.clouds.values() for _, seconds in cloud.ask("take_one_way")]

    def sent_bytes(self) -> int:
        """Return the bytes of UDP payload that the robot has sent so far, over all its interfaces."""
        links = self.robot.ask("counters")["links"].values()
        return sum(int(link["bytes"].get("sent", 0)) for link in links)
