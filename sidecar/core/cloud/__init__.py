"""Plays the cloud's role: executes each request once and delivers the answers.

Imports `base`, `wire`, `seam`, `rules` and `transfer`.
"""
