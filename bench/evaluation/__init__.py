"""Compares the whole system with the alternatives that a user has, on the same recorded windows of drives and walks.

A scenario is a file of `scenarios/`: what is requested, how often, and over which two paths. A contender is one way to
get the answers. `python -m bench evaluate` runs one with the other in the network lab and records every request.
"""
