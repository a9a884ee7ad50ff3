"""Decides which copies of a request leave, where and when. Imports `robot.measure` and `robot.request`."""
