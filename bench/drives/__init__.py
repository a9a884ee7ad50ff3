"""Runs the real cores over recorded drives in simulated time, and compares them with oracles."""
