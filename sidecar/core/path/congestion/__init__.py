"""How fast one path may send: round trips, rate, window, queue, policer. Imports nothing of the core."""
