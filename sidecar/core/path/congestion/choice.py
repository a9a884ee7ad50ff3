"""Names the congestion controllers that a link can give to its paths."""

from __future__ import annotations

from typing import TYPE_CHECKING

from plr.sidecar.core.path.congestion.model_controller import ModelController
from plr.sidecar.core.path.congestion.new_reno import NewReno

if TYPE_CHECKING:
    from collections.abc import Callable

    from plr.sidecar.core.path.congestion.controller import CongestionController

DEFAULT_CONTROLLER = "model"
CONTROLLERS: dict[str, Callable[[], CongestionController]] = {
    DEFAULT_CONTROLLER: ModelController,
    "new-reno": NewReno,
}
"""What makes the controller of a new path, by name. Only the default is for use; others are for comparison."""
