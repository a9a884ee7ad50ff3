"""A cloud's sidecar that gives answers which are none, to as many requests as a file says.

A member of the fleet with a good certificate, whose program somebody has changed: `python -m lab.attacker.rogue_cloud
--config FILE.yaml`. FILE.share beside it holds the share of bad answers, in [0, 1]; without it all are honest.
"""

from __future__ import annotations

import random
import sys
from pathlib import Path
from typing import Any

from sidecar import __main__ as sidecar
from sidecar.core.engine.engine import Engine

SHARE = ".share"
GARBAGE_BYTES = 10


def main() -> int:
    """Command line of the sidecar."""
    share_file = Path(sys.argv[sys.argv.index("--config") + 1]).with_suffix(SHARE)
    honest = Engine.complete

    def complete(engine: Engine, execution: Any, payload: bytes, processing_s: float, now: float) -> None:
        share = float(share_file.read_text()) if share_file.exists() else 0.0
        if random.random() < share:
            payload, processing_s = random.randbytes(GARBAGE_BYTES), 0.0
        honest(engine, execution, payload, processing_s, now)

    # What somebody has changed.
    setattr(Engine, "complete", complete)  # noqa: B010 - it is no method of ours
    return sidecar.main()


if __name__ == "__main__":
    sys.exit(main())
