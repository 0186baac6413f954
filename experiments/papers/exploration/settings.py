"""Constants of the study of exploration; the configuration is in conf/study/exploration.yaml."""

from experiments.evaluation.verdict import Profile

STRATEGIES = ("random", "nearest_frontier", "information_gain", "coordinated")
BASE, JUDGED = "nearest_frontier", "coordinated"
FIRST_SEED = 1000  # of the judged worlds
WORLDS = {  # by strategy; the claim is of two of them
    Profile.FULL: {BASE: 30, JUDGED: 30, "information_gain": 4, "random": 4},
    Profile.QUICK: dict.fromkeys(STRATEGIES, 2),
}
AFTER_M = 15.0  # driven a robot, after which the area is judged
RESOLUTION_M = 0.2  # of the area
N_ROBOTS = 3
MARGIN = 1.10  # of the map's error
