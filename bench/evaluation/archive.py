"""The records of runs in one file, so that what was published can be worked out anew, and gone on from."""

from __future__ import annotations

import io
import tarfile
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

    from bench.evaluation.outcome import Outcome


def pack(outcomes: Iterable[Outcome], folder: str) -> bytes:
    """A tar.xz with each record at FOLDER/SCENARIO/CONTENDER.json; the same records make the same bytes."""
    file = io.BytesIO()
    with tarfile.open(fileobj=file, mode="w:xz") as archive:
        for outcome in sorted(outcomes, key=lambda one: (one.scenario, one.contender)):
            data = outcome.text().encode()
            entry = tarfile.TarInfo(f"{folder}/{outcome.scenario}/{outcome.contender}.json")
            entry.size = len(data)
            archive.addfile(entry, io.BytesIO(data))
    return file.getvalue()
