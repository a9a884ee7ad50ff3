"""The metrics follow the core, and series of those that are gone go too."""

from __future__ import annotations

import time

import prometheus_client

from plr.controlplane.observe.fleet_metrics import REUSED_S, Fleet
from plr.controlplane.observe.metrics import Metrics
from plr.protos.model.report import OutcomeReport, Report
from tests.support.control_world import World
from tests.support.samples import PLAN


def text(metrics: Metrics, world: World) -> str:
    metrics.update(world.core, [], 3)
    return prometheus_client.generate_latest(metrics.registry).decode()


def fleet_of(world: World) -> Fleet:
    views = (world.core.view(sidecar.name, world.now) for sidecar in world.core.registry)
    return Fleet([view for view in views if view is not None], (), {}, world.now, 1.7e9)


def test_metrics_follow_the_core() -> None:
    world, metrics = World(), Metrics()
    metrics.watch_fleet(lambda: fleet_of(world))
    world.cloud("a")
    robot = world.robot()
    robot.refuse = lambda message: True
    world.say(robot, Report(outcomes=(OutcomeReport(PLAN, ok=3, failed=1),)))
    world.run(2.0)
    shown = text(metrics, world)
    for line in (
        'plr_connected_sidecars{role="cloud"} 1.0',
        'plr_resource_sync{resource="peers",state="synced"} 1.0',
        'plr_resource_sync{resource="peers",state="rejected"} 1.0',
        f'plr_nacks_total{{resource="peers"}} {float(world.core.counters.nacks.total() - 1)}',
        'plr_observed_miss_ratio{robot="robot",service="/plan"} 0.25',
        'plr_predicted_miss_probability{robot="robot",service="/plan"} 0.25',
        "plr_plan_excess_interfaces 1.0",
        'plr_control_dropped_total{reason="superseded_before_sent"} 3.0',
    ):
        assert line in shown
    world.leave(robot)
    world.run(2.0)
    time.sleep(REUSED_S)
    shown = text(metrics, world)
    assert 'robot="robot"' not in shown
    assert 'plr_departures_total{reason="left"} 1.0' in shown


def test_before_the_first_update_there_are_no_values_but_no_failure_either() -> None:
    assert "plr_connected_sidecars" not in prometheus_client.generate_latest(Metrics().registry).decode()
