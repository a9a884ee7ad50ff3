"""Who is in the local ROS graph, and what its types are."""
