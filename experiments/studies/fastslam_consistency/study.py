"""Is FastSLAM's covariance that of its errors? NEES by distance, particles and proposal.

All estimators run over the same recordings, whose noise is the one that they believe.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from experiments.evaluation.metrics import nees_at_distances
from experiments.judging.jobs import Progress, Tables, group_by, tables_of
from experiments.judging.remake import Cells, Remake, agrees
from experiments.judging.results import Profile, Results
from experiments.runs.evaluate import run_over
from experiments.runs.experiment import Experiment
from experiments.runs.row import Row
from experiments.runs.seeds import stream
from experiments.sweeps.plan import plan_experiments

DISTANCES_M = (10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0, 80.0, 90.0)
MAX_QUICK = 1000  # particles


def run(profile: Profile, out: Results, on_progress: Progress) -> None:
    """Run the study and write its table.

    Parameters
    ----------
    profile
        `quick`: up to 1000 particles in four worlds; `full`: up to 10,000 in twenty.
    """
    jobs = [[part] for part in group_by(plan(profile), lambda one: one.seed)]
    out.write_tables(**tables_of(rows_of, jobs, on_progress))


def plan(profile: Profile) -> Iterator[Experiment]:
    """All runs, or those of the quick profile."""
    if profile is Profile.FULL:
        return plan_experiments(["study=fastslam_consistency"])
    runs = plan_experiments(["study=fastslam_consistency", "seed=range(1000,1004)"])
    return (one for one in runs if one.option("n_particles", 0) <= MAX_QUICK)


REMADE = {"nees": 2.0}


def remake(_table: str, row: Cells) -> Remake:
    """The call that makes a row again."""
    runs = plan_experiments(["study=fastslam_consistency", f"seed={row['seed']:.0f}"])
    one = next(one for one in runs if agrees(row, labels_of(one)))
    return rows_of, ([one],)


def rows_of(runs: Sequence[Experiment]) -> Tables:
    """NEES at each distance of every run over one recording; NaN where it is not known."""
    recording = runs[0].recording()
    rows: list[Row] = []
    for one in runs:
        labels = labels_of(one)
        rng = stream(one.seed, f"estimator/{labels}")
        online, revised = run_over(recording, one.estimator(), one.prior(recording), rng)
        found = revised if one.estimator_name == "smoother" and revised else online
        truth = recording.truth_at(found.stamps)
        nees = nees_at_distances(truth, found.means, found.covariances, np.array(DISTANCES_M))
        rows += [
            {**labels, "seed": one.seed, "distance_m": distance_m, "nees": float(value)}
            for distance_m, value in zip(DISTANCES_M, nees, strict=True)
        ]
    return {"nees": rows}


def labels_of(one: Experiment) -> Row:
    """Columns that name a run: its filter, M, and in what it differs from the default."""
    name = one.estimator_name
    if name == "fastslam":
        name = {"motion": "fastslam1", "optimal": "fastslam2"}[one.option("proposal")]
    changed = {
        "resampled at every image": one.option("ess_share") == 1.0,
        "resampled below M / 10": one.option("ess_share") == 0.1,
        "four times the slip": one.option("kr") > one.robot().kr,
        "twice the image noise": one.option("sigma_column_px") is not None,
    }
    remedy = next((words for words, is_so in changed.items() if is_so), "none")
    name = {"smoother": "batch"}.get(name, name)
    return {"filter": name, "n_particles": one.option("n_particles", 0), "remedy": remedy}
