"""Global localization in offices: how often, and how soon, Monte Carlo localization succeeds.

A robot drives the whole tour of each office once; starts are spread evenly along it. From each the
filter begins without a pose and is judged over the next 40 m.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from experiments.evaluation.metrics import heading_errors_rad, position_errors_m, travelled_m
from experiments.evaluation.statistics import bootstrap_interval, share_interval
from experiments.judging.jobs import Progress, Tables, tables_of
from experiments.judging.remake import Cells, Remake
from experiments.judging.results import Profile, Results
from experiments.runs.console import RunFailedError
from experiments.runs.evaluate import run_over
from experiments.runs.experiment import Experiment
from experiments.runs.row import Row
from experiments.runs.seeds import stream
from experiments.studies.mcl_office.settings import FOR_M, N_STARTS, NEAR_M, NEAR_RAD, WITHIN_M
from experiments.sweeps.plan import plan_experiments
from sim.arrays import Array
from sim.recording import Recording


def run(profile: Profile, out: Results, on_progress: Progress) -> None:
    """Run the study and write its tables: the starts, and the share of them localised.

    Parameters
    ----------
    profile
        `quick`: 3 starts in each of 4 offices; `full`: 20 in each of 10.
    """
    n_starts, fewer = (N_STARTS, []) if profile is Profile.FULL else (3, ["seed=range(1000,1004)"])
    jobs = [(office, n_starts) for office in plan_experiments(["study=mcl_office", *fewer])]
    made = tables_of(starts, jobs, on_progress)
    out.write_tables(**made, share=localised_share(made["starts"]))


REMADE = {"starts": 15.0}  # the shares are means of them


def remake(_table: str, row: Cells) -> Remake:
    """The call that makes a row again."""
    office = Experiment.compose(["study=mcl_office", f"seed={row['seed']:.0f}"])
    return starts, (office, N_STARTS, [int(row["start"])])


def localised_share(table: pd.DataFrame) -> pd.DataFrame:
    """Share of starts localised: its exact binomial interval, and the bootstrap over offices."""
    hits = table["localised"].to_numpy(bool)
    offices = table.pivot(index="seed", columns="start", values="localised").to_numpy(float)
    shares = pd.DataFrame(
        [
            share_interval(int(hits.sum()), len(hits)),
            bootstrap_interval(offices, lambda a: float(a.mean()), np.random.default_rng(0)),
        ]
    )
    shares.insert(0, "independent", ["starts", "offices"])
    return shares.assign(median_found_m=table["found_m"].median())


def found_after_m(travel_m: Array, near: NDArray[np.bool_]) -> float:
    """Travel after which the belief is and stays near the truth, m; infinite if not in time.

    Parameters
    ----------
    travel_m, near
        (T,) travel since the start, and whether the belief is near the truth.
    """
    for i in np.flatnonzero(near & (travel_m <= WITHIN_M)):
        after = (travel_m >= travel_m[i]) & (travel_m <= travel_m[i] + FOR_M)
        if travel_m[-1] >= travel_m[i] + FOR_M and near[after].all():
            return float(travel_m[i])
    return math.inf


def starts(experiment: Experiment, n_starts: int, chosen: Sequence[int] | None = None) -> Tables:
    """Localize from starts spread along the tour of an office; by default from all.

    Returns
    -------
    Tables
        `starts`, a row a start: `seed`, `start`; where, `x_m`, `y_m`; `localised`; the travel after
        which the belief is near and stays near for 10 m, `found_m` (infinite: never within 30 m);
        `error_m`, `error_deg` at the end; `near_share` of the Frames after it was found;
        `particles_mean`.

    Raises
    ------
    RunFailedError
        If the robot did not drive the whole tour.
    """
    recording = experiment.recording()
    if recording.status != "ok":
        raise RunFailedError(f"seed {experiment.seed}: the drive ended early: {recording.status}")
    travel_m = travelled_m(recording.truth_at(recording.frame_stamps))
    last_m = travel_m[-1] - WITHIN_M - FOR_M - 1.0
    first_rows = np.searchsorted(travel_m, (np.arange(n_starts) + 0.5) / n_starts * last_m)
    rows: list[Row] = [
        {"seed": experiment.seed, "start": i, **_start(experiment, recording, travel_m, row, i)}
        for i, row in enumerate(first_rows.tolist())
        if chosen is None or i in chosen
    ]
    return {"starts": rows}


def _start(
    experiment: Experiment, recording: Recording, travel_m: Array, row: int, start: int
) -> Row:
    """One start, at a row of the Frames."""
    end = int(np.searchsorted(travel_m, travel_m[row] + WITHIN_M + FOR_M + 0.5))
    part = dataclasses.replace(recording, frame_stamps=recording.frame_stamps[row:end])
    rng = stream(experiment.seed, "starts", start)
    prior = experiment.prior(recording)
    found, _ = run_over(part, experiment.estimator(), prior, rng, keep=["particles"])
    poses = recording.truth_at(found.stamps)
    errors_m = position_errors_m(poses, found.means)
    errors_rad = heading_errors_rad(poses, found.means)
    near = (errors_m < NEAR_M) & (np.abs(errors_rad) < NEAR_RAD)
    gone_m = travel_m[row:end] - travel_m[row]
    found_m = found_after_m(gone_m, near)
    after = gone_m >= found_m
    return {
        "x_m": float(poses[0, 0]),
        "y_m": float(poses[0, 1]),
        "localised": math.isfinite(found_m),
        "found_m": found_m,
        "error_m": float(errors_m[-1]),
        "error_deg": math.degrees(abs(errors_rad[-1])),
        "near_share": float(near[after].mean()) if after.any() else math.nan,
        "particles_mean": float(np.mean(list(map(len, found.extras["particles"])))),
    }
