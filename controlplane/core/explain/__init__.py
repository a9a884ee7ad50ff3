"""Answers for the operator: why a mapping is as it is, who is there, who is gone.

Imports everything but `settle` and `control`.
"""
