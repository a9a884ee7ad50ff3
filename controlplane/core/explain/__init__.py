"""Answers the operator: why a mapping is as it is, who is present, who is gone.

Imports everything but `settle` and `control`.
"""
