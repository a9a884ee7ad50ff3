"""Something small kept of each member. Imports nothing of the core."""
