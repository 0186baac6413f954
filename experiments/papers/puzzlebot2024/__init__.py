"""Odometry covariance with kr and kl."""
