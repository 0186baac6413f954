"""Constants of the study; the rest is in conf/study/fastslam_consistency.yaml."""

DISTANCES_M = (10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0, 80.0, 90.0)
QUICK_SEEDS = "range(1000,1004)"
MAX_QUICK = 1000  # particles
