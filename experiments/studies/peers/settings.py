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
    "mrpt_mcl": "mrpt",
    "mrpt_rbpf": "mrpt",
}
LASER, MAP, STEREO, WHEELS = "laser", "laser, known map", "landmarks", "wheels"
# What a method reads beside the wheels, where that is not the laser alone.
READS = {
    "odometry": WHEELS,
    **dict.fromkeys(("mcl", "mrpt_mcl"), MAP),
    **dict.fromkeys(("ekf_slam", "fixed_lag", "smoother", "gtsam_isam2", "gtsam_batch"), STEREO),
}
