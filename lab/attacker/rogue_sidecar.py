"""A robot's sidecar that asks for /echo whatever its application calls, and whatever its mapping says.

A member of the fleet with a good certificate, whose program somebody has changed: `python -m
lab.attacker.rogue_sidecar --config FILE`.
"""

from __future__ import annotations

import dataclasses
import sys
from typing import Any

from protos.model.ids import ServiceName
from sidecar import __main__ as sidecar
from sidecar.core.robot.dispatch import dispatcher
from sidecar.core.wire.messages import RequestMessage

WANTED = ServiceName("/echo")


def main() -> int:
    """Command line of the sidecar."""

    def forged(*arguments: Any, **fields: Any) -> RequestMessage:
        return dataclasses.replace(RequestMessage(*arguments, **fields), service=WANTED)

    # What somebody has changed.
    assert hasattr(dispatcher, "RequestMessage"), "the requests are made elsewhere by now"
    setattr(dispatcher, "RequestMessage", forged)  # noqa: B010 - the module does not export it
    return sidecar.main()


if __name__ == "__main__":
    sys.exit(main())
