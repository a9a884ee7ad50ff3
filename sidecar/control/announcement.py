"""Announces this run's addresses: no more than peers use, numbered, and signed with the certificate's key."""

from __future__ import annotations

import logging
from collections import Counter
from itertools import islice
from typing import TYPE_CHECKING

from plr.protos.convert.fields import MAX_CANDIDATES
from plr.protos.model.members import MAX_CANDIDATES_OF_INTERFACE, CandidateSet, InterfaceLabel
from plr.protos.trust.candidate_signature import sign_candidates

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

    from plr.protos.model.ids import InterfaceName, SessionId
    from plr.protos.model.members import Candidate
    from plr.protos.program.tls_files import TlsFiles

log = logging.getLogger(__name__)


class Announcer:
    """Makes the announcements of one session; it must not be used by several threads at once.

    `tls` returns the current certificate and key; None means insecure mode. `labels` returns what is known of
    interfaces.
    """

    def __init__(
        self,
        session: SessionId,
        tls: Callable[[], TlsFiles] | None,
        labels: Callable[[Iterable[InterfaceName]], tuple[InterfaceLabel, ...]],
    ) -> None:
        self._session = session
        self._tls = tls
        self._labels = labels
        self._serial = 0
        self._candidates: tuple[Candidate, ...] = ()
        self._down: tuple[InterfaceName, ...] = ()
        self._left_out: dict[InterfaceName, int] = {}

    def announce(self, candidates: Iterable[Candidate], down: Iterable[InterfaceName] = ()) -> CandidateSet:
        """Return the announcement of these candidates, the best of each interface first; it takes some 0.1 ms.

        `down` lists interfaces that would have candidates if they carried anything.
        """
        found = tuple(candidates)
        announced = {candidate.interface for candidate in found}
        self._down = tuple(islice((name for name in down if name not in announced), MAX_CANDIDATES))
        self._candidates = tuple(islice(_first_of_each(found), MAX_CANDIDATES))
        self._log_left_out(found)
        return self.again()

    def again(self) -> CandidateSet:
        """Return the last announcement, signed with the current certificate."""
        self._serial += 1
        signature = b""
        if self._tls is not None:
            signature = sign_candidates(self._tls().private_key, self._session, self._serial, self._candidates)
        labels = self._labels(candidate.interface for candidate in self._candidates)
        known = {label.interface: label for label in self._labels(self._down)}
        down = tuple(known.get(name) or InterfaceLabel(name) for name in self._down)
        return CandidateSet(self._candidates, labels, self._serial, signature, down)

    def _log_left_out(self, found: tuple[Candidate, ...]) -> None:
        left_out = Counter(one.interface for one in found) - Counter(one.interface for one in self._candidates)
        for name in left_out.keys() - self._left_out.keys():
            log.warning(
                "%s: %d of its addresses are not announced: peers use only a few of each interface",
                name,
                left_out[name],
            )
        self._left_out.update(left_out)  # logged once in a run


def _first_of_each(candidates: Iterable[Candidate]) -> Iterator[Candidate]:
    counts: Counter[InterfaceName] = Counter()
    for candidate in candidates:
        counts[candidate.interface] += 1
        if counts[candidate.interface] <= MAX_CANDIDATES_OF_INTERFACE:
            yield candidate
