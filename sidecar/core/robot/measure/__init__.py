"""Measures and reports for the robot. Imports `robot.request`."""
