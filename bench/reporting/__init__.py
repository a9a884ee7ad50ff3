"""Presents the findings of all measurements: tables, targets with verdicts, pages."""
