"""Provides the base of the contract: errors, histogram, size classes, durations. Imports nothing of ours."""
