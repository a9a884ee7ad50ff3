"""Solves the problem, and bounds how much better any plan could be. Imports `problem`."""
