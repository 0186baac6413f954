"""Where recordings come from: worlds, the robot, its sensors, and readers of real logs."""
