"""Writes into the pages what the code says: the keys of the configurations, the figures of the limits."""
