"""Controls congestion on one path: round trips, rate, window, queue, policer. Imports nothing of the core."""
