"""The whole system beside what a user would take instead, all replaying the same windows of drives and walks.

A scenario is a file of `scenarios/`: what is asked, how often, and over which two paths. A contender is one way to get
the answers. `python -m bench evaluate` runs one with the other in the network lab and writes a record of every request.
"""
