"""Runs a robot's sidecar that requests /echo whatever its application calls, and whatever its mapping says.

It is a member of the fleet with a valid certificate and a changed program: `python -m lab.attacker.rogue_sidecar
--config FILE`.
"""

from __future__ import annotations

import dataclasses
import sys
from typing import Any

from plr.protos.model.ids import ServiceName
from plr.sidecar import __main__ as sidecar
from plr.sidecar.core.robot.dispatch import dispatcher
from plr.sidecar.core.wire.messages import RequestMessage

WANTED = ServiceName("/echo")


def main() -> int:
    """Run the sidecar's command line."""

    def forged(*arguments: Any, **fields: Any) -> RequestMessage:
        return dataclasses.replace(RequestMessage(*arguments, **fields), service=WANTED)

    # The change to the program.
    assert hasattr(dispatcher, "RequestMessage"), "the requests are made elsewhere by now"
    setattr(dispatcher, "RequestMessage", forged)  # noqa: B010 - the module does not export it
    return sidecar.main()


if __name__ == "__main__":
    sys.exit(main())
