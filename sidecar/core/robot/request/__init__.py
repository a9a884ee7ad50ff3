"""One request and its copies, and what decides where they may go. The lowest of the robot's packages."""
