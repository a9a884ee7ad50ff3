"""Turns reports into probabilities: what network and servers take, and how well that is known.

Imports nothing of the core.
"""
