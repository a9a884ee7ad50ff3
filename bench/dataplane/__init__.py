"""Measures the data plane against its targets, beside the alternatives that users have.

`make bench-dataplane` runs every section of `sections/` and writes bench/results/dataplane.json and dataplane.html.
Each contender is a program of its own (`programs/`), driven over a pipe (`remote.py`), on this host or on a host of
the network lab. One section's contenders run interleaved, in the same minutes on the same machine: quote the ratios.
"""
