"""Routes: what the robot is commanded, and by which pose it steers."""
