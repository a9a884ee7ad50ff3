"""The sidecar: carries a node's ROS services over every network interface to the sidecars of others."""
