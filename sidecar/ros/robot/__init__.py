"""Runs the robot's end: services offered in place of their servers, and fallbacks."""
