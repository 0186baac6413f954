"""Constants of the studies; the rest is in conf/study/decristoforis2020/*.yaml."""

JUDGED_SEED = 1000  # seeds 0-99 are for tuning
RATE_HZ = 75.0  # of the laser as printed, at which DC1 and DC6 are judged
PAPERS_OWN = ("odometry", "icp", "fusion")
CHECKED = (*PAPERS_OWN, "fusion_clone")  # also run at other rates, rays and noise
N_DRIVES, N_GEOMETRIES = 40, 20  # of DC1 and DC6; of DC2 to DC5
N_REPEATS = 60  # registrations of each pair of scans
NEES_AT_M = (5.0, 20.0, 50.0, 95.0)
CONSISTENT = (0.8, 1.25)  # NEES over its degrees of freedom
PLACES = {  # where pairs of scans are taken: study, and place of its world
    "corridor": ("corridor", "corridor_bare"),
    "corner": ("corridor", "corner"),
    "curve": ("corridor", "curve"),
    "room": ("office", "room"),
}
PAIRS = ("room_small", "room_large", "corridor_small", "corridor_large")  # of bench.icp
WINDOWS_S = (1.0, 10.0)  # over which steps of registration are composed
HELD_M = 0.02  # standard deviation of a step above which the walls leave a direction free
