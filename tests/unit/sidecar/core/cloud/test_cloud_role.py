"""What a cloud does not do."""

from __future__ import annotations

import pytest

from plr.protos.model.ids import NodeName, Role, Version
from plr.protos.model.mapping import MappingSet
from plr.protos.model.report import Report
from plr.sidecar.core.engine.engine import WrongRoleError
from plr.sidecar.core.seam.links import PathMeasured
from tests.unit.sidecar.core.engine.test_engine import Sidecar


def test_a_cloud_sends_no_requests_and_takes_no_mapping() -> None:
    sidecar = Sidecar(Role.CLOUD, NodeName("robot"))
    with pytest.raises(WrongRoleError):
        _ = sidecar.engine.robot
    assert sidecar.engine.uses() == ()
    assert sidecar.engine.apply_mapping(MappingSet(Version(1), 1, ()))
    assert sidecar.engine.service_mappings == ()
    assert sidecar.engine.stats.nacks == 1


def test_a_cloud_reports_nothing() -> None:
    """The control plane ignores what it would say: robots measure the same paths."""
    sidecar = Sidecar(Role.CLOUD, NodeName("robot"))
    sidecar.engine.on_link_event(PathMeasured(sidecar.path, 0.1, (0.1,), 1, 0), 0.1)
    assert sidecar.engine.routes.rtt(sidecar.path) == 0.1
    assert sidecar.engine.take_urgency() is None
    assert sidecar.engine.take_report(0.2) == Report()
