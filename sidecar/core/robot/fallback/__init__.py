"""Lets local services stand in for the network. Imports no other package of the robot."""
