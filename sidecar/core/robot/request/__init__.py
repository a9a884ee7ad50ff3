"""Holds one request and its copies, and decides where they may go. The lowest of the robot's packages."""
