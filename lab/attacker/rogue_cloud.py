"""Runs a cloud's sidecar that gives invalid answers to a share of the requests set in a file.

It is a member of the fleet with a valid certificate and a changed program: `python -m lab.attacker.rogue_cloud
--config FILE.yaml`. FILE.share beside it holds the share of bad answers, in [0, 1]; without it all are honest.
"""

from __future__ import annotations

import random
import sys
from pathlib import Path
from typing import Any

from plr.sidecar import __main__ as sidecar
from plr.sidecar.core.cloud.cloud_role import CloudRole

SHARE = ".share"
GARBAGE_BYTES = 10


def main() -> int:
    """Run the sidecar's command line."""
    share_file = Path(sys.argv[sys.argv.index("--config") + 1]).with_suffix(SHARE)
    honest = CloudRole.complete

    def complete(cloud: CloudRole, execution: Any, payload: bytes, processing_s: float, now: float) -> None:
        share = float(share_file.read_text()) if share_file.exists() else 0.0
        if random.random() < share:
            payload, processing_s = random.randbytes(GARBAGE_BYTES), 0.0
        honest(cloud, execution, payload, processing_s, now)

    # The change to the program.
    setattr(CloudRole, "complete", complete)  # noqa: B010 - it is no method of ours
    return sidecar.main()


if __name__ == "__main__":
    sys.exit(main())
