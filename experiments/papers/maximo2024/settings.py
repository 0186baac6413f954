"""Constants of the study of maximo2024: sizes, seeds, chosen parameters, what the paper prints."""

from experiments.judging.results import Profile
from experiments.runs.paths import SOURCE

# The Oxford positions of the paper, if available
POSITIONS = SOURCE.parent / "shared" / "data" / "oxford_positions" / "positions.csv.gz"
# Geometries of the tables, the paper's first; controls have their queries off the route
NAMES = {
    "oxford": "Oxford's route as printed",
    "oxford_real": "Oxford's real positions",
    "umh": "UMH's route as printed",
    "campus": "campus clouds",
    "oxford_plane": "Oxford's route, plane offsets",
    "umh_plane": "UMH's route, plane offsets",
}
# The free settings that are shared by both data sets, as the findings name them
SIGMA_L, SIGMA_M, B = "sigma_l, node spacings", "estimator.sigma_m", "estimator.n_nearest"
PLACES = {"oxford": "Oxford", "oxford_real": "Oxford", "umh": "UMH"}  # of the printed levels
CONTROLS = ("oxford_plane", "umh_plane")

N_WORLDS = {Profile.FULL: 20, Profile.QUICK: 2}  # of each route; of the weightings, by design
N_RUN_SEEDS = {Profile.FULL: 3, Profile.QUICK: 1}  # worlds of each of the fifteen Oxford runs
N_RETRIEVED_CAMPUSES = 5
# MX5 and MX8, sizes by design.yaml
CLUSTERED = ("ring_key", "m2dp")  # Scan Context turns with the robot: k-means does not allow for it
N_CLUSTERED_CAMPUSES = {Profile.FULL: 24, Profile.QUICK: 2}
N_KIDNAPPED_CAMPUSES = {Profile.FULL: 20, Profile.QUICK: 1}
N_KIDNAPPED_ROUTES = {Profile.FULL: 60, Profile.QUICK: 2}  # worlds of each route
N_CAMPUS_KIDNAPPINGS = {Profile.FULL: 15, Profile.QUICK: 5}  # in each campus
N_CAMPUS_STARTS = {Profile.FULL: 12, Profile.QUICK: 10}  # in each campus
N_KIDNAPPINGS = 5  # in each world of a route
N_TIMINGS = {Profile.FULL: 25, Profile.QUICK: 2}  # taken in turn, since machines are disturbed
N_REPEATS = {Profile.FULL: 10, Profile.QUICK: 2}  # in each world
N_STARTS = {Profile.FULL: 20, Profile.QUICK: 10}

METHODS = ("M1", "M2", "M3")
PER_NODE = (2, 4, 6, 8)  # particles, table 2
LEAST_M = 1e-3  # added to dispersions that may be zero, before a logarithm
QUICK_STEPS = 136  # of a region's runs in the quick profile
TOLERANCE = 1.5  # spacings: an estimate within is right
HELD = 10  # steps that it has to stay right
WITHIN = 40  # steps to localize in
RECOVERED_WITHIN = 20  # nodes
KIDNAPPED_AFTER = 30  # steps
CAMPUS_SHIFT_M = 1.0  # from the map's lane to the queries'

BETWEEN_NODES_S = 2.56  # of Oxford, as the paper has it
ITERATIONS = (0, 5, 10, 21)  # of figure 6
DRAWN_DESCRIPTOR = "m2dp"  # of the campus
# Figure 5, UMH: mean error and deviation along the route, m, from each start
PRINTED_5 = {"umh": ((0.41, 0.29), (0.42, 0.22), (0.58, 0.71))}
# Tables 1 and 2: mean error and deviation, m
PRINTED_1 = {
    ("oxford", "M1"): (11.54, 0.38),
    ("oxford", "M2"): (9.61, 0.26),
    ("oxford", "M3"): (205.79, 38.88),
    ("umh", "M1"): (1.72, 0.38),
    ("umh", "M2"): (0.40, 0.01),
    ("umh", "M3"): (0.44, 0.01),
}
PRINTED_2 = {
    "oxford": {794: (9.62, 1.09), 1588: (9.73, 0.32), 2382: (9.73, 0.31), 3176: (9.25, 0.45)},
    "umh": {272: (0.40, 0.03), 544: (0.42, 0.02), 816: (0.42, 0.03), 1088: (0.41, 0.01)},
}
