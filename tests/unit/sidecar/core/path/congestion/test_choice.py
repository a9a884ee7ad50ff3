from __future__ import annotations

from plr.sidecar.core.path.congestion.choice import CONTROLLERS, DEFAULT_CONTROLLER
from plr.sidecar.core.path.congestion.model_controller import ModelController


def test_a_path_gets_the_model_unless_another_controller_is_named() -> None:
    assert isinstance(CONTROLLERS[DEFAULT_CONTROLLER](), ModelController)


def test_each_path_gets_a_controller_of_its_own() -> None:
    for make in CONTROLLERS.values():
        assert make() is not make()
