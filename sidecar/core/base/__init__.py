"""Provides the bottom layer: identities and reasons, timers, fair shares. Imports nothing of the core."""
