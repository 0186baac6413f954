"""Constants of the gil2008 studies; the configuration is in conf/study/gil2008*.yaml."""

from experiments.evaluation.verdict import Profile

# Each study's table, and the estimator's keys that name its rows
LABELS: dict[str, tuple[str, ...]] = {
    "particles": ("n_particles",),
    "bound": (),
    "observations": (),
    "repeats": ("n_particles",),
    "distance": (),
    "association": ("association", "p0"),
    "resampling": ("resampling", "ess_share"),
    "noise": ("noise_at",),
}
N_WORLDS = {Profile.FULL: 50, Profile.QUICK: 2}
N_REPEATS = {Profile.FULL: 20, Profile.QUICK: 3}  # of a run
N_DRAWS = {Profile.FULL: 5, Profile.QUICK: 2}  # of the wheel errors
N_TIMINGS = {Profile.FULL: 5, Profile.QUICK: 2}
SEED = 1000  # of the first world
P0 = 1e-3  # in the rows of estimators without a p0
FARTHEST_M = 20.0  # images are drawn with all landmarks within this distance
LAG_M = 20.0  # ground is revisited when the robot was there at least this much path ago
WITHIN_M = 1.0  # and this near
