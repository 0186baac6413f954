"""Constants of the gil2008 studies; what is configuration stands in conf/study/gil2008*.yaml."""

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
QUICK = ("seed=range(1000,1002)",)  # in place of a study's own twenty worlds
QUICK_BY_TABLE = {"repeats": ("repeats=3",)}
QUICK_DRAWS = 2  # of the wheel errors
COST_REPEATS = {"full": 5, "quick": 2}
P0 = 1e-3  # names the row of an estimator that has none
FARTHEST_M = 20.0  # images are drawn with all landmarks within
LAG_M = 20.0  # ground is revisited when the robot was there at least this much path ago
WITHIN_M = 1.0  # and this near
