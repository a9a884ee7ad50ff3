"""Finds out who is in the local ROS graph, and of which types."""
