"""What one robot's requests of a service meet over an interface beyond what network and processing times explain.

Those times are of the last minutes, while outcomes tell within seconds that a radio has got bad. What is amiss is then
mostly the interface's own, so a path over it that carries nothing is no way out: it would only look like one.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from controlplane.core.estimate.posterior import Estimate

if TYPE_CHECKING:
    from protos.model.ids import InterfaceName, NodeName

SUREST = 1e-9
"""Nothing is taken to be more probable than 1 less this, nor less probable than this."""


class InterfaceTrouble:
    """By interface, how much worse its paths do than expected: a difference of logits, 0 where they do not."""

    __slots__ = ("_met",)

    def __init__(self) -> None:
        self._met: dict[InterfaceName, list[tuple[NodeName, float, float]]] = {}
        """(server, requests, difference) of each path that carried requests."""

    def note(
        self, interface: InterfaceName, server: NodeName, requests: float, expected: Estimate, found: Estimate
    ) -> None:
        """So many requests on this path bring what was expected of it, from its times, to what was found."""
        worse = max(0.0, _logit(found.mean) - _logit(expected.mean))
        self._met.setdefault(interface, []).append((server, requests, worse))

    def moved(self, expected: Estimate, interface: InterfaceName, server: NodeName) -> Estimate:
        """What is expected of a path, moved as much as the paths to other servers over its interface were, on average
        over their requests."""
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
