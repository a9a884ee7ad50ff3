"""Runs real cores in simulated time: no socket, no thread, no clock."""
