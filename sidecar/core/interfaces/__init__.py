"""Decides which interfaces are ready, and when to look at them. Stands by itself."""
