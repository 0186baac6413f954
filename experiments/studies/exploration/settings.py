"""Constants of the study of exploration; the configuration is in conf/study/exploration.yaml."""

from experiments.judging.results import Profile

BASE, JUDGED = "nearest_frontier", "coordinated"
SHARED, GAIN = "shared_frontiers", "information_gain"  # each with one half of what is judged
NAMES = {  # of the strategies, in words
    "random": "random",
    BASE: "nearest frontier",
    SHARED: "shared out by cost",
    GAIN: "information gain",
    JUDGED: "coordinated",
}
FIRST_SEED = 1000  # of the judged worlds
WORLDS = {Profile.FULL: 30, Profile.QUICK: 2}
AFTER_M = 15.0  # driven a robot, after which the area is judged
RESOLUTION_M = 0.2  # of the area
N_ROBOTS = 3
MARGIN = 1.10  # of the map's error
