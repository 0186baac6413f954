"""What the study shows of each method; the runs are in conf/study/peers.yaml."""

CLASSES = ("rooms", "office", "curved", "clutter", "people", "changed")
TUNED = "_tuned"  # ends the name of an option that `estima tune peers` wrote
COMPETING = ("shipped", "informed", "tuned")  # arms; others have wrong beliefs, and stand beside
# Package of each peer, whose version the table gives; what is not here is ours.
PACKAGES = {
    "small_gicp": "small_gicp",
    "small_gicp_keyframe": "small_gicp",
    "kiss_icp": "kiss-icp",
    "kiss_icp_wheels": "kiss-icp",
    "gtsam_isam2": "gtsam",
    "gtsam_batch": "gtsam",
    "filterpy_ekf": "filterpy",
    "karto": "karto-scanmatcher",
    "mrpt_icp": "mrpt",
    "mrpt_mcl": "mrpt",
    "mrpt_rbpf": "mrpt",
    "nav2_amcl": "nav2",
}
LASER, MAP, STEREO, WHEELS = "laser", "laser, known map", "landmarks", "wheels"
# What a method reads beside the wheels, where that is not the laser alone.
READS = {
    "odometry": WHEELS,
    **dict.fromkeys(("mcl", "mrpt_mcl", "nav2_amcl"), MAP),
    **dict.fromkeys(
        ("ekf_slam", "fixed_lag", "smoother", "filterpy_ekf", "gtsam_isam2", "gtsam_batch"), STEREO
    ),
}

# Real logs: robots of MRCLAM on which no option was chosen; starts in Wean Hall's map (m, m, rad),
# as real_logs finds them in cells of 0.2 m and steps of 4 degrees, and how far they may be off
MRCLAM_ROBOTS = (3, 4, 5)
WEAN_STARTS = {1: (40.7, 41.3, -1.60570291183), 2: (46.1, 40.7, -1.67551608191)}
WEAN_SIGMAS = (0.2, 0.2, 0.05)
TOO_DEAR = ("mrpt_rbpf",)  # a grid a particle: as much time as all other methods of other projects
CAP_M = 1.0  # of a beam's distance from the nearest wall
