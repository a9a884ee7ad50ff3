"""Builds the problem from who is present and what was measured.

Imports `registry`, `policy`, `estimate` and `problem`.
"""
