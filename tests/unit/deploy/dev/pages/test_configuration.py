"""The page describes every kind of key."""

from __future__ import annotations

from typing import Annotated

import pytest
from pydantic import Field

from deploy.dev.pages.configuration import described, keys_of
from plr.controlplane.config.controlplane import ControlPlaneConfig
from plr.protos.model.ids import Role
from plr.protos.program.config_fields import ListenAddress
from plr.sidecar.config.fields import OnlyOn, RepairShare, Section
from plr.sidecar.config.service import PriorityWord
from plr.sidecar.config.sidecar import SidecarConfig


class Inner(Section):
    """A section."""

    allow: bool
    """Whether."""


class Outer(Section):
    """All kinds of keys."""

    wait_ms: Annotated[float | None, Field(gt=0, le=5), OnlyOn(Role.ROBOT, "robots wait")] = None
    """First line, which goes on
    here.

    - `one`: an item, which goes on
      here.
    - `two`: another one."""
    share: Annotated[float, Field(gt=0, lt=1)] = 0.5
    """A share."""
    retries: Annotated[int, Field(ge=0, le=7)] = 3
    """A count."""
    priority: PriorityWord = PriorityWord.NORMAL
    """A word."""
    fec: RepairShare = "auto"
    """Words or a number."""
    listen: ListenAddress | None = "[::]:1"
    """An address, or none."""
    inners: Annotated[tuple[Inner, ...], Field(max_length=4), OnlyOn(Role.CLOUD, "clouds have them")] = ()
    """A list."""
    others: tuple[ListenAddress, ...] = ("[::]:2",)
    """Another list."""
    single: Inner = Inner(allow=True)
    """One section."""


FACTS = [
    ("wait_ms", "robot · number (ms) above 0 and up to 5"),
    ("share", "both · number above 0 and below 1 · default: `0.5`"),
    ("retries", "both · whole number from 0 to 7 · default: `3`"),
    ("priority", "both · `low`, `normal` or `high` · default: `normal`"),
    ("fec", "both · `off`, `auto` or number from 0 to 1 · default: `auto`"),
    ("listen", "both · address:port or `null` · default: `[::]:1`"),
    ("inners", "cloud · list of sections (at most 4) · default: empty"),
    ("inners[].allow", "cloud · `true` or `false` · required"),
    ("others", "both · list of address:port entries · default: `[::]:2`"),
    ("single", "both · section"),
    ("single.allow", "both · `true` or `false` · required"),
]


def test_the_facts_of_a_key_are_those_of_its_field() -> None:
    assert [(key.name, key.facts) for key in keys_of(Outer.model_json_schema(), "both")] == FACTS


def test_a_docstring_becomes_filled_paragraphs_and_lists() -> None:
    text = described(keys_of(Outer.model_json_schema()), {"share": "[more](more.md)"})
    assert (
        "### `wait_ms`\n\nrobot · number (ms) above 0 and up to 5\n\nFirst line, which goes on here.\n\n"
        "- `one`: an item, which goes on here.\n- `two`: another one.\n\n### `share`\n"
    ) in text
    assert "A share.\n\nSee [more](more.md).\n\n### `retries`\n" in text
    assert "\n#### `inners[].allow`\n" in text


def test_a_link_at_no_key_is_refused() -> None:
    with pytest.raises(ValueError, match="got shares"):
        described(keys_of(Outer.model_json_schema()), {"shares": "[more](more.md)"})


@pytest.mark.parametrize("model", [SidecarConfig, ControlPlaneConfig])
def test_every_key_of_the_programs_is_described(model: type[SidecarConfig | ControlPlaneConfig]) -> None:
    keys = keys_of(model.model_json_schema())
    assert {key.name for key in keys if "." not in key.name} == set(model.model_fields)
    assert [key.name for key in keys if not key.description.endswith(".")] == []
