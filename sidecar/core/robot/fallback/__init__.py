"""Local services that stand in for the network. Imports no other package of the robot."""
