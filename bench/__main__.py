"""Measurements of the system, each beside its anchor from the same run.

examples:
  make bench-dataplane                                       compares the data plane with its targets; a page of plots
  make bench-dataplane BENCH_ARGS='--quick --only one_way'
  make bench-churn BENCH_ARGS='--minutes 3'                  interfaces, servers and sidecars come and go under load
  make bench-insiders BENCH_ARGS='--minutes 2'               a robot and a cloud of the fleet attack the others
  make bench-control BENCH_ARGS='--size 500'                 a fleet's control streams at one control plane
  python -m bench alerts                                     what a real Alertmanager says when one server of five dies
  python -m bench drives --traces ~/traces                   the real cores beside oracles, in simulated time
  python -m bench micro                                      counts what one request passes through: calls, files
  make bench-fleet-day BENCH_ARGS='--members 100 --hours 6'  shows whether anything drifts or grows in a day
  make bench-quick                                           15 s of a drive with every contender
  python -m bench evaluate --scenario 'drive-*' --contender plr-replicate
  python -m bench report --out bench/results                 makes verdicts, page and summary again from the records
  python -m bench report --out DIR --again DIR2 --publish    compares two evaluations; writes the figures into the docs
  python -m bench scenarios --traces ~/traces                shows what the evaluation replays
  make bench-matcher BENCH_ARGS='--traces ~/traces'          shows whether the matcher's predictions are true
"""

from __future__ import annotations

import argparse
import sys

from bench.alerts import command as alerts
from bench.churn import command as churn
from bench.control import command as control
from bench.dataplane import command as dataplane
from bench.drives import command as drives
from bench.evaluation import command as evaluate
from bench.evaluation import report_command as report
from bench.evaluation import scenarios_command as scenarios
from bench.fleetday import command as fleet_day
from bench.insiders import command as insiders
from bench.matcher import command as matcher
from bench.micro import command as micro


def main() -> int:
    """Run the command line; without a measurement, run all of them."""
    parser = argparse.ArgumentParser(
        prog="python -m bench", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", metavar="MEASUREMENT")
    dataplane.add_arguments(commands.add_parser("dataplane", help="compare the data plane with its targets"))
    churn.add_arguments(
        commands.add_parser("churn", help="cause minutes of trouble; count requests lost or doubled, and memory grown")
    )
    insiders.add_arguments(
        commands.add_parser("insiders", help="let two members attack all the others in every way at once")
    )
    control.add_arguments(
        commands.add_parser(
            "control", help="measure the control plane with 500 to 4,000 sidecars: starts, load, a dead server"
        )
    )
    alerts.add_arguments(commands.add_parser("alerts", help="show what a real Alertmanager says when a server dies"))
    fleet_day.add_arguments(
        commands.add_parser("fleet-day", help="simulate 24 hours of a fleet of 1,000: nothing drifts, nothing grows")
    )
    drives.add_arguments(
        commands.add_parser("drives", help="compare the real cores with oracles on recorded drives, in simulated time")
    )
    matcher.add_arguments(
        commands.add_parser("matcher", help="compare predicted with observed misses, on recorded traces")
    )
    micro.add_arguments(commands.add_parser("micro", help="count calls, functions and files of one request"))
    scenarios.add_arguments(
        commands.add_parser("scenarios", help="show what is replayed, and the generator beside traces")
    )
    evaluate.add_arguments(commands.add_parser("evaluate", help="compare the system with others on replayed networks"))
    report.add_arguments(
        commands.add_parser("report", help="make the reports from the records of the evaluation, without a run")
    )
    given = (
        [sys.argv[1:]]
        if sys.argv[1:]
        else [[name] for name in ("dataplane", "churn", "insiders", "control", "fleet-day", "matcher", "evaluate")]
    )
    runs = {
        "alerts": alerts.run,
        "churn": churn.run,
        "control": control.run,
        "dataplane": dataplane.run,
        "drives": drives.run,
        "evaluate": evaluate.run,
        "fleet-day": fleet_day.run,
        "insiders": insiders.run,
        "matcher": matcher.run,
        "micro": micro.run,
        "report": report.run,
        "scenarios": scenarios.run,
    }
    return max(runs[options.command](options) for options in map(parser.parse_args, given))


if __name__ == "__main__":
    sys.exit(main())
