"""Says what a report contains. Urgent reports are short, so that a control plane hears a whole fleet soon."""

from __future__ import annotations

import enum


class ReportScope(enum.Enum):
    """How much of what was measured."""

    CHANGES = "changes"
    """Paths that went up or down since the last report, with what was measured of them. The rest follows when the next
    report is due anyway."""

    ALL = "all"
    """Everything since the last report."""
