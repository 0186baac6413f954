"""What the study shows of each method; the runs are in conf/study/peers.yaml."""

TUNED = "_tuned"  # ends the name of an option that `estima tune peers` wrote
# Package of each peer, whose version the table gives; what is not here is ours.
PACKAGES = {
    "small_gicp": "small_gicp",
    "small_gicp_keyframe": "small_gicp",
    "kiss_icp": "kiss-icp",
    "gtsam_isam2": "gtsam",
    "gtsam_batch": "gtsam",
    "mrpt_icp": "mrpt",
    "mrpt_rbpf": "mrpt",
}
# Methods that read landmarks; the others, but for odometry, read the laser.
LANDMARKS = ("ekf_slam", "fixed_lag", "smoother", "gtsam_isam2", "gtsam_batch")
LASER, STEREO, WHEELS = "laser", "landmarks", "wheels"
