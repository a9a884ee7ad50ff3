"""Defines what all sections of the control plane's configuration have in common."""

from __future__ import annotations

from pydantic import BaseModel

from plr.protos.program.config_fields import STRICT


class Section(BaseModel):
    """A section: checked strictly, then frozen."""

    model_config = STRICT
