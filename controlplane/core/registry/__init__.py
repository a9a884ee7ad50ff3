"""Who is there: registrations, leases, and whether they agree with their certificates.

Imports `base` and `overload`.
"""
