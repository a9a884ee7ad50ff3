"""plr doctor: check this node, without the control plane, and say what is wrong and what to do.

examples:
  plr doctor                                   the sidecar of /etc/plr/sidecar.yaml, as root or in the group plr
  plr doctor --config try/robot.yaml           another sidecar
  plr doctor --json | jq '.findings[] | select(.level != "ok")'

Each line is a check: ok, warn (somebody should look) or fail (something does not work), with what to do. Paths are
pinged over the data plane. If the sidecar does not run, the other checks still do.

exit codes: 0 ok or warnings only, 1 a failure, 2 bad usage
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from typing import TYPE_CHECKING, Any

from plr.protos.base.printable import escaped
from plr.protos.program.exit_codes import EXIT_NO, EXIT_OK
from plr.sidecar.doctor.examination import examine
from plr.sidecar.doctor.finding import Level
from plr.sidecar.doctor.options import parser_of, where_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from plr.sidecar.doctor.examination import Examination
    from plr.sidecar.doctor.finding import Finding


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `plr doctor` and return its exit code."""
    parser = parser_of("plr doctor", __doc__)
    parser.add_argument("--json", action="store_true", help="print findings and the sidecar's state as JSON")
    parser.add_argument("--no-ping", action="store_true", help="do not ping the paths")
    options = parser.parse_args(arguments)
    seen = examine(where_of(options), pinging=not options.no_ping)
    sys.stdout.write(as_json(seen) if options.json else as_text(seen.findings))
    return EXIT_NO if any(one.level is Level.FAIL for one in seen.findings) else EXIT_OK


def as_text(findings: Iterable[Finding]) -> str:
    """Return a line for each finding, and a last one that counts them."""
    findings = list(findings)
    width = max((len(one.check) for one in findings), default=0)
    lines = []
    for one in findings:
        remedy = f"; do: {one.remedy}" if one.remedy else ""
        lines.append(f"{one.level.value:<4}  {one.check:<{width}}  {escaped(one.text + remedy)}")
    counts = Counter(one.level for one in findings)
    lines.append(f"{counts[Level.FAIL]} failures, {counts[Level.WARN]} warnings, {counts[Level.OK]} ok")
    return "\n".join(lines) + "\n"


def as_json(seen: Examination) -> str:
    """Return the findings as JSON, with the state of the running sidecar that they come from."""
    shown: dict[str, Any] = {
        "findings": [
            {"level": one.level.value, "check": one.check, "text": one.text, "do": one.remedy} for one in seen.findings
        ],
        "sidecar": seen.state,
    }
    return json.dumps(shown, indent=2) + "\n"
