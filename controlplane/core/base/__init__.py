"""Keeps something small for each member. Imports nothing of the core."""
