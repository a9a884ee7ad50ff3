"""Builds the problem from who is there and what was measured.

Imports `registry`, `policy`, `estimate` and `problem`.
"""
