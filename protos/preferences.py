"""What sidecars want of the choice of paths, and what they say of their interfaces for it; without IO."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from protos.model import InterfaceName

DEFAULT_CHARGE = 1.0
"""What a request over an interface costs unless said otherwise: so that a service that is to be cheap sends few copies
where nobody told what they cost."""


@dataclass(frozen=True, slots=True)
class InterfaceLabel:
    """What a robot says of one of its interfaces, for the choice of paths."""

    interface: InterfaceName
    carrier: str = ""
    """Whose network it uses; interfaces with the same one fail together. Empty: not known."""
    charge: float = DEFAULT_CHARGE
    """What a request over it costs, in any one currency."""


class Copies(NamedTuple):
    """How many copies of a request are sent, each over another interface; 0: as many as there are interfaces."""

    least: int = 0
    most: int = 0

    def over(self, interfaces: int) -> Copies:
        """The numbers for so many interfaces."""
        return Copies(*(min(count or interfaces, interfaces) for count in self))


EVERY_INTERFACE = Copies()
AT_MOST_EVERY_INTERFACE = Copies(least=1)
