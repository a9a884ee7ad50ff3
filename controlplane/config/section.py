"""Defines what all sections of the control plane's configuration have in common."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class Section(BaseModel):
    """A section: no unknown keys, then frozen."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)
