"""Plain ROS 2 applications. They import nothing of FogROS2-PLR and run with or without it."""
