"""Motion planning as a service: A* on a warehouse map (nav_msgs/srv/GetPlan)."""
