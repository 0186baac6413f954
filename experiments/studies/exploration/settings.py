"""Constants of the study of exploration; the configuration is in conf/study/exploration.yaml."""

# Coordination is to share the frontiers out; the information gain and both together stand beside
BASE, JUDGED = "nearest_frontier", "shared_frontiers"
BOTH, GAIN = "coordinated", "information_gain"
NAMES = {  # of the strategies, in words
    "random": "random",
    BASE: "nearest frontier",
    JUDGED: "shared out by cost",
    GAIN: "information gain",
    BOTH: "shared out, weighted by gain",
}
AFTER_M = 15.0  # driven a robot, after which the area is judged
RESOLUTION_M = 0.2  # of the area
N_ROBOTS = 3
MARGIN = 1.10  # of the map's error
