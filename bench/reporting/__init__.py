"""What all measurements show their findings with: tables, targets with verdicts, pages."""
