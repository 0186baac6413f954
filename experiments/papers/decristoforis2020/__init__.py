"""EKF fusion of odometry and ICP with a covariance for ICP."""
