"""Plays the cloud's role: executes each request once and delivers the answers.

Imports `base`, `wire`, `message`, `seam`, `rules` and `transfer`. The engine calls `cloud_role`.
"""
