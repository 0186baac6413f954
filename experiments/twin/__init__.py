"""A twin: from a real log to a simulation of the robot that made it."""
