"""The cloud's role: executions, each once, and their answers.

Imports `base`, `wire`, `seam`, `rules` and `transfer`.
"""
