"""Represents the configuration's rules for services and budgets for copies. Imports `base` and `message`."""
