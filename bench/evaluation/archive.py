"""Packs the records of runs into one file, so that published figures can be recomputed and extended."""

from __future__ import annotations

import io
import tarfile
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

    from bench.evaluation.outcome import Outcome


def pack(outcomes: Iterable[Outcome], folder: str) -> bytes:
    """Return a tar.xz with each record at FOLDER/SCENARIO/CONTENDER.json; the same records give the same bytes."""
    file = io.BytesIO()
    with tarfile.open(fileobj=file, mode="w:xz") as archive:
        for outcome in sorted(outcomes, key=lambda one: (one.scenario, one.contender)):
            data = outcome.text().encode()
            entry = tarfile.TarInfo(f"{folder}/{outcome.scenario}/{outcome.contender}.json")
            entry.size = len(data)
            archive.addfile(entry, io.BytesIO(data))
    return file.getvalue()
