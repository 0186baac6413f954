"""Global localization in offices: how often, and how soon, Monte Carlo localization finds itself.

A robot drives the whole tour of each office once; starts are spread evenly along it. From each the
filter begins without a pose and is judged over the next 40 m. `python -m
experiments.papers.mcl_office.study` runs it; it takes some five minutes of processor time.
"""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import joblib
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import NDArray

from estimators.base import Prior
from experiments.evaluation.metrics import heading_errors_rad, position_errors_m
from experiments.evaluation.statistics import Interval, bootstrap_interval, share_interval
from experiments.runs.compose import compose
from experiments.runs.console import progress
from experiments.runs.experiment import Config, default_cache, make_estimator, make_recording
from experiments.runs.row import write_frame
from experiments.runs.seeds import stream
from experiments.runs.version import ROOT
from sim.recording import Frame, Recording

Array = NDArray[np.float64]
Tables = dict[str, pd.DataFrame]
Profile = Literal["quick", "full"]

STUDY = "mcl_office"
JUDGED_SEED = 1000  # seeds 0-99 are for tuning
WITHIN_M, FOR_M = 30.0, 10.0  # localised: within so much travel, and then for so long
NEAR_M, NEAR_RAD = 0.5, math.radians(10.0)
_CONFIG = (
    "world=office",
    "robot=robocom",
    "route.speed_mps=0.7",
    "sensors=lms291",
    "sensors.laser.rate_hz=5",
    "sensors.laser.n_beams=181",
    "simulation.physics=kinematic",
    "simulation.rays=exact",
    "estimator=mcl",
)


def run(profile: Profile, out: Path, on_progress: Callable[[float], None]) -> Tables:
    """Run the study and write its table to `out`.

    Parameters
    ----------
    profile
        `quick`: 3 starts in each of 4 offices; `full`: 20 in each of 10.
    out
        Folder of the table.
    on_progress
        Called with the share done.
    """
    n_worlds, n_starts = (10, 20) if profile == "full" else (4, 3)
    seeds = range(JUDGED_SEED, JUDGED_SEED + n_worlds)
    tables = {"starts": starts(seeds, n_starts, on_progress=on_progress)}
    write_frame(tables["starts"], out / f"{STUDY}_starts.csv")
    return tables


def figures(tables: Tables) -> dict[str, Figure]:
    """The study's figure."""
    from experiments.papers.mcl_office.figures import found_by

    return {f"{STUDY}_found": found_by(tables["starts"])}


def starts(
    seeds: Sequence[int],
    n_starts: int,
    overrides: Sequence[str] = (),
    on_progress: Callable[[float], None] = lambda share: None,
) -> pd.DataFrame:
    """Localize from starts spread along the tour of each office.

    Parameters
    ----------
    seeds
        One office each.
    n_starts
        Starts in each office.
    overrides
        Of the configuration, such as `estimator.tries=1`.

    Returns
    -------
    DataFrame
        One row a start: `seed`, `start`; `x_m`, `y_m`, where; `localised`; `found_m`, the travel
        after which the belief is near and stays near for 10 m (infinite: never within 30 m);
        `error_m`, `error_deg` at the end; `near_share` of the Frames after it was found;
        `particles_mean`.
    """
    jobs = [joblib.delayed(_starts_of)(seed, n_starts, tuple(overrides)) for seed in seeds]
    rows: list[dict[str, Any]] = []
    done = joblib.Parallel(n_jobs=-1, return_as="generator")(jobs)
    for i, found in enumerate(done):
        rows += found
        on_progress((i + 1) / len(jobs))
    return pd.DataFrame(rows)


def localised_share(table: pd.DataFrame) -> tuple[Interval, Interval]:
    """Share of starts localised: its exact binomial interval, and the bootstrap over offices."""
    hits = table["localised"].to_numpy(bool)
    offices = table.pivot(index="seed", columns="start", values="localised").to_numpy(float)
    by_office = bootstrap_interval(offices, lambda a: float(a.mean()), np.random.default_rng(0))
    return share_interval(int(hits.sum()), len(hits)), by_office


def found_after_m(travel_m: Array, near: NDArray[np.bool_]) -> float:
    """Travel after which the belief is near and stays near, m; infinite if not in time.

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


def _starts_of(seed: int, n_starts: int, overrides: tuple[str, ...]) -> list[dict[str, Any]]:
    """All starts in one office."""
    config = compose([*_CONFIG, f"seed={seed}", *overrides])
    recording = make_recording(config, default_cache())
    if recording.status != "ok":
        raise RuntimeError(f"seed {seed}: the drive ended badly: {recording.status}")
    truth = recording.truth_at(recording.frame_stamps)
    steps = np.hypot(*np.diff(truth[:, :2], axis=0).T)
    travel_m = np.concatenate([[0.0], np.cumsum(steps)])
    frames = list(recording.frames())
    last_m = travel_m[-1] - WITHIN_M - FOR_M - 1.0
    first_rows = np.searchsorted(travel_m, (np.arange(n_starts) + 0.5) / n_starts * last_m)
    return [
        {"seed": seed, "start": i}
        | _start(config, recording, frames, truth, travel_m, int(row), stream(seed, "starts", i))
        for i, row in enumerate(first_rows)
    ]


def _start(
    config: Config,
    recording: Recording,
    frames: list[Frame],
    truth: Array,
    travel_m: Array,
    row: int,
    rng: np.random.Generator,
) -> dict[str, Any]:
    """One start, at a Frame's row."""
    end = int(np.searchsorted(travel_m, travel_m[row] + WITHIN_M + FOR_M + 0.5))
    assert recording.truth is not None
    estimator = make_estimator(config)
    estimator.reset(Prior(recording.robot, recording.sensors, map=recording.truth.world), rng)
    first = dataclasses.replace(frames[row], duration_s=0.0, wheel_increments_m=np.zeros(2))
    beliefs = [estimator.step(frame) for frame in (first, *frames[row + 1 : end])]
    means, poses = np.array([belief.mean for belief in beliefs]), truth[row:end]
    errors_m, errors_rad = position_errors_m(poses, means), heading_errors_rad(poses, means)
    near = (errors_m < NEAR_M) & (np.abs(errors_rad) < NEAR_RAD)
    gone_m = travel_m[row:end] - travel_m[row]
    found_m = found_after_m(gone_m, near)
    after = gone_m >= found_m
    return {
        "x_m": truth[row, 0],
        "y_m": truth[row, 1],
        "localised": math.isfinite(found_m),
        "found_m": found_m,
        "error_m": errors_m[-1],
        "error_deg": math.degrees(abs(errors_rad[-1])),
        "near_share": float(near[after].mean()) if after.any() else math.nan,
        "particles_mean": float(np.mean([len(b.extras["particles"]) for b in beliefs])),
    }


def main() -> None:
    """Run the study as asked for on the command line: `quick` or `full`."""
    from experiments.viewing.style import save_figure

    profile: Profile = "quick" if "quick" in sys.argv[1:] else "full"
    with progress(STUDY, 1.0) as on_progress:
        tables = run(profile, ROOT / "results" / "tables", on_progress)
    for name, page in figures(tables).items():
        save_figure(page, ROOT / "results" / "figures" / f"{name}.png")
    table = tables["starts"]
    exact, by_office = localised_share(table)
    print(f"{len(table)} starts in {table['seed'].nunique()} offices")
    print(
        f"localised: {exact.value:.3f} [{exact.low:.3f}, {exact.high:.3f}], as independent trials"
    )
    print(
        f"           {by_office.value:.3f} [{by_office.low:.3f}, {by_office.high:.3f}], by office"
    )
    print(f"found after, median: {table['found_m'].median():.1f} m")


if __name__ == "__main__":
    main()
