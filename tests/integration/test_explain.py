"""`plr explain` asks a real control plane, over real gRPC."""

from __future__ import annotations

import json

import grpc
import pytest

from plr.controlplane.cli.__main__ import main
from plr.protos.model.report import Report
from plr.protos.plr.v1 import admin_pb2, admin_pb2_grpc
from tests.support.control_plane_process import PATIENCE_S, ControlPlaneProcess, cloud, robot
from tests.support.samples import histogram, latency, path


def explain(plane: ControlPlaneProcess, *arguments: str) -> int:
    return main(["explain", "--insecure", "--address", plane.address, *arguments])


def test_a_mapping_is_explained(plane: ControlPlaneProcess, capsys: pytest.CaptureFixture[str]) -> None:
    with cloud(plane.address, "cloud-a"), cloud(plane.address, "cloud-b"), robot(plane.address) as r:
        r.peers("cloud-a", "cloud-b")
        r.send(
            Report(
                latencies=(latency("wlan0", "cloud-a", histogram(0.02, times=90, lost=10)),),
                paths=tuple(
                    path(nic, server, rtt=histogram(0.01, times=9))
                    for nic in ("wlan0", "wwan0")
                    for server in ("cloud-a", "cloud-b")
                ),
            )
        )
        mapping = r.mapping("cloud-a", "cloud-b")
        assert explain(plane, "robot", "/plan") == 0
        text = capsys.readouterr().out
        assert "robot /plan: deadline 100 ms, idempotent, objective joint" in text
        assert "mapping in force" in text
        assert mapping.services[0].reason in text
        assert explain(plane, "--json", "robot", "/plan") == 0
        shown = json.loads(capsys.readouterr().out)
        tried = next(p for p in shown["pairs"] if p["path"] == {"interface": "wlan0", "server": "cloud-a"})
        assert tried["requests"] == pytest.approx(100, rel=0.5)
        assert tried["network"]["lost"]
        assert tried["miss"]["low"] < tried["miss"]["mean"] < tried["miss"]["high"]
        assert explain(plane, "robo", "/plan") == 1
        assert capsys.readouterr().err == "plr: no robot robo is registered; did you mean robot?\n"


def test_names_are_checked_on_either_side(plane: ControlPlaneProcess, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        explain(plane, "robot", "plan")
    assert left.value.code == 2
    assert "fully qualified ROS name" in capsys.readouterr().err
    with grpc.insecure_channel(plane.address) as channel:
        stub = admin_pb2_grpc.AdminStub(channel)
        with pytest.raises(grpc.RpcError) as refused:
            stub.Explain(admin_pb2.ExplainRequest(robot="no spaces", service="/plan"), timeout=PATIENCE_S)
    assert refused.value.code() is grpc.StatusCode.INVALID_ARGUMENT
