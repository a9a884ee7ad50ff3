"""Simulates a day in the life of a fleet: the control plane's core and the control streams of a thousand sidecars."""
