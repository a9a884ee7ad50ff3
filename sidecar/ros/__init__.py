"""Carries ROS: the only package that imports rclpy."""
