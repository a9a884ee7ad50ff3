"""Measurements of the system, each beside its anchor from the same run.

examples:
  make bench-dataplane                                     the data plane against its targets, with a page of plots
  make bench-dataplane BENCH_ARGS='--quick --only one_way'
"""

from __future__ import annotations

import argparse
import sys

from bench.dataplane import command as dataplane


def main() -> int:
    """Command line; without a measurement, all of them."""
    parser = argparse.ArgumentParser(
        prog="python -m bench", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", metavar="MEASUREMENT")
    dataplane.add_arguments(commands.add_parser("dataplane", help="the data plane against its targets"))
    return dataplane.run(parser.parse_args(sys.argv[1:] or ["dataplane"]))


if __name__ == "__main__":
    sys.exit(main())
