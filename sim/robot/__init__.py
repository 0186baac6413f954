"""The differential-drive robot: its geometry, its slip, and the bodies that move by it."""
