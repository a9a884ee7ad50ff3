"""FogROS2-PLR: one folder for each of the three packages, which the top-level folders of their names hold."""
