"""Measurements of the system, each beside its anchor from the same run.

examples:
  make bench                                   every measurement, reports into bench/results
  make bench BENCH_ARGS='calls --seconds 60'   the call through two sidecars, and the silent blackhole
"""

from __future__ import annotations

import argparse
import sys

from bench import calls


def main() -> int:
    """Command line; without a measurement, all of them."""
    parser = argparse.ArgumentParser(
        prog="python -m bench", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", metavar="MEASUREMENT")
    calls.add_arguments(commands.add_parser("calls", help="proxied and direct service calls, the silent blackhole"))
    arguments = sys.argv[1:]
    return calls.run(parser.parse_args(arguments or ["calls"]))


if __name__ == "__main__":
    sys.exit(main())
