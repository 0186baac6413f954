"""Constants of the gil2008 studies; the configuration is in conf/study/gil2008*.yaml."""

from experiments.judging.results import Profile

# Each study's table, and the estimator's keys that name its rows
LABELS: dict[str, tuple[str, ...]] = {
    "particles": ("n_particles",),
    "laps": (),
    "bound": (),
    "observations": (),
    "repeats": ("n_particles",),
    "distance": (),
    "association": ("association", "p0"),
    "divergence": ("association", "p0"),
    "resampling": ("resampling", "ess_share"),
    "noise": (),
}
# Tables whose worlds are added until these claims are decided
DESIGNED = {"particles": ["GI1", "GI3"], "laps": ["GI1"], "distance": ["GI4", "GI5"],
            "divergence": ["GI7"]}  # fmt: skip
SHARED = {"divergence": "association"}  # tables whose runs another table configures
N_QUICK = 2  # worlds of the quick profile
CELL_M = 0.1  # of the occupancy grids
N_REPEATS = {Profile.FULL: 20, Profile.QUICK: 2}  # of a run, or of the images over one drive
REGION_ARMS = ((10, 10), (200, 3), (200, 10), (200, 20), (1000, 10))  # particles, dmax
FEWER = {Profile.FULL: {}, Profile.QUICK: {200: 50, 1000: 100}}  # particles in their place
N_DRAWS = {Profile.FULL: 8, Profile.QUICK: 2}  # of the wheel errors
N_TIMINGS = {Profile.FULL: 25, Profile.QUICK: 2}  # taken in turn, since machines are disturbed
DESCRIPTORS = 0.9  # their noise in the headline of GI7
P0 = 1e-3  # in the rows of estimators without a p0
FARTHEST_M = 20.0  # images are drawn with all landmarks within this distance
LAG_M = 20.0  # ground is revisited when the robot was there at least this much path ago
WITHIN_M = 1.0  # and this near
SETTLED_M = 20.0  # places first visited on so much path from the known start do not count
