"""What the robot measures and reports. Imports `robot.request`."""
