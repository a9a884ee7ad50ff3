"""Keeps who is present: registrations, leases, and whether they agree with their certificates.

Imports `base` and `overload`.
"""
