"""Estimates what one robot's requests of a service meet over an interface beyond network and processing times.

Those times cover the last minutes, while outcomes tell within seconds that a radio has become bad. The trouble is then
mostly the interface's own, so an idle path over it is no way out: it would only look like one.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from plr.controlplane.core.estimate.posterior import Estimate

if TYPE_CHECKING:
    from plr.protos.model.ids import InterfaceName, NodeName

SUREST = 1e-9
"""No probability is taken to be nearer to 0 or 1 than this."""


class InterfaceTrouble:
    """By interface, how much worse its paths do than expected: a difference of logits, 0 if they do not."""

    __slots__ = ("_met",)

    def __init__(self) -> None:
        self._met: dict[InterfaceName, list[tuple[NodeName, float, float]]] = {}
        """(server, requests, difference) of each path that carried requests."""

    def note(
        self, interface: InterfaceName, server: NodeName, requests: float, expected: Estimate, found: Estimate
    ) -> None:
        """Note that this many requests on this path move the estimate from `expected`, by its times, to `found`."""
        worse = max(0.0, _logit(found.mean) - _logit(expected.mean))
        self._met.setdefault(interface, []).append((server, requests, worse))

    def moved(self, expected: Estimate, interface: InterfaceName, server: NodeName) -> Estimate:
        """Return what is expected of a path, moved as much as the paths to other servers over its interface were,
        averaged over their requests."""
        others = [(requests, worse) for of, requests, worse in self._met.get(interface, ()) if of != server]
        total = sum(requests for requests, _ in others)
        worse = sum(requests * worse for requests, worse in others)
        if not worse:
            return expected
        mean = 1.0 / (1.0 + math.exp(-_logit(expected.mean) - worse / total))
        return Estimate.of(min(mean, 1.0 - SUREST), expected.weight)


def _logit(probability: float) -> float:
    bounded = min(max(probability, SUREST), 1.0 - SUREST)
    return math.log(bounded / (1.0 - bounded))
