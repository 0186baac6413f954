"""The study of GI9: the error of a team with and without sightings of one another.

A world is driven through once by five robots; a smaller team is the first of them. The arms share
everything but the sightings: recordings, starts, map, and the filter's stream.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import operator
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import scipy

from estimators.base import Estimate
from estimators.landmarks.ekf_slam import EkfSlam
from estimators.team import Communication, run_team
from experiments.evaluation.metrics import score
from experiments.judging.jobs import Progress, Tables, answer_of, tables_of
from experiments.judging.logs import CALIBRATED_S, MRCLAM_6, calibrate_by_truth, known_start
from experiments.judging.region_runs import region_jobs, remake_region
from experiments.judging.remake import Cells, Remake, agrees, whole
from experiments.judging.results import FIRST_SEED, Profile, Results
from experiments.judging.sequential import run_worlds
from experiments.runs.experiment import Experiment
from experiments.runs.row import Row
from experiments.studies.teams import settings
from experiments.studies.teams.claims import gi9
from experiments.viewing.team_figure import drive_of, sightings
from sim.arrays import Array
from sim.formats import mrclam
from sim.recording import Recording
from sim.sensors import Mount
from sim.team import Team

_KEPT = {  # columns of a run's row, and what the study's table calls them
    "answer_ate_rmse_m": "ate_rmse_m",
    "worst_robot_rmse_m": "worst_robot_m",
    "answer_nees_mean": "answer_nees",
    "n_sightings": "n_sightings",
    "step_time_us": "step_us",
    "n_landmarks": "n_landmarks",
    "map_rmse_m": "map_rmse_m",
    "map_aligned_rmse_m": "map_aligned_rmse_m",
}


def run(profile: Profile, out: Results, on_progress: Progress) -> None:
    """Run the study; write its tables, and the drive that the figure shows.

    Parameters
    ----------
    profile
        `quick`: two worlds.
    """
    regions = region_jobs("teams", region_run, profile)
    first = FIRST_SEED[profile]
    batch = [(rows_of, first + i, "smoother") for i in range(settings.WORLDS[profile])]
    tables = tables_of(operator.call, [*batch, *regions], lambda share: on_progress(0.5 * share))
    made = run_worlds("teams", ["GI9"], profile, _worlds, lambda t: list(gi9(t["errors"])))
    tables["errors"] = pd.concat([tables["errors"], made["errors"]], ignore_index=True)
    out.write_tables(**tables)
    if MRCLAM_6.exists():
        out.write_tables(mrclam=_mrclam_table())
    out.write_arrays("drive", **drive(first))
    on_progress(1.0)


def _worlds(seeds: Sequence[int]) -> Mapping[str, pd.DataFrame]:
    return tables_of(rows_of, [(seed, option) for seed in seeds for option in settings.FILTERS])


def region_run(_name: str, values: Mapping[str, Any], seed: int, profile: Profile) -> Row:
    """Errors of the printed filter with and without sightings at free settings in one world."""
    kept, size = dict(values), int(values["team.size"])
    keys = {**kept, "robot.kl": values["robot.kr"]}
    if profile is Profile.QUICK:
        keys["route.distance_m"] = 8.0
    row: Row = {}
    for overrides, labels in _arms(size, settings.PRINTED):
        one = compose_experiment(seed, overrides | keys)
        found = answer_of(one, ["answer_ate_rmse_m"])["answer_ate_rmse_m"]
        row["with_m" if labels["sightings"] else "without_m"] = found
    return row


REMADE = {"errors": 5.0, "mrclam": 120.0, "region_GI9": 8.0}


def remake(table: str, row: Cells) -> Remake | None:
    """The call that makes a row again; None without the log that it is from."""
    if table.startswith("region_"):
        return remake_region("teams", region_run, table, row)
    if table == "errors":
        return rows_of, (int(row["seed"]), row["filter"], row)
    return (whole, (table, _mrclam_table)) if MRCLAM_6.exists() else None


def _mrclam_table() -> pd.DataFrame:
    return pd.DataFrame(mrclam_rows(MRCLAM_6))


def rows_of(seed: int, option: str, only: Row | None = None) -> Tables:
    """Rows of an estimator's runs in one world, for each size of the team; or only one row."""
    rows: list[Row] = []
    five = compose_experiment(seed, {}).recordings()
    for size in settings.SIZES:
        team = functools.partial(five.first, size)
        for overrides, labels in _arms(size, option):
            shared = {"seed": seed, "size": size, "filter": option, **labels}
            if only is not None and not agrees(only, shared):
                continue
            held: list[tuple[float, float]] = []

            def hold(own: Recording, _: object, online: Estimate, __: object) -> None:
                held.append(uncertainty(own, online))  # noqa: B023 - called within the turn

            experiment = compose_experiment(seed, overrides)
            found = answer_of(experiment, _KEPT, team, on_estimate=hold)
            inside, sigma_m = np.mean(held, axis=0)
            row = {_KEPT[name]: value for name, value in found.items()}
            rows.append(shared | row | {"inside_share": inside, "sigma_m": sigma_m})
    return {"errors": rows}


def uncertainty(own: Recording, online: Estimate) -> tuple[float, float]:
    """Share of true positions inside the belief's 95 % ellipse, and its RMS deviation, m."""
    off = own.truth_at(online.stamps)[:, :2] - online.means[:, :2]
    covariances = online.covariances[:, :2, :2] + 1e-12 * np.eye(2)
    squares = np.sum(off * np.linalg.solve(covariances, off[..., None])[..., 0], axis=1)
    variance = np.trace(covariances, axis1=1, axis2=2).mean()
    return float(np.mean(squares <= scipy.stats.chi2.ppf(0.95, 2))), math.sqrt(float(variance))


def _arms(size: int, option: str) -> Iterator[tuple[dict[str, Any], Row]]:
    """Overrides of each run of a team of this size, and its labels."""
    for used in (False, True):
        seen = "robots" if used else "null"
        base = {"team.size": size, "estimator": option, "estimator.robots": seen}
        if option in settings.N_PARTICLES:
            base["estimator.n_particles"] = settings.N_PARTICLES[option]
        yield base, {"sightings": used, "link": settings.ALWAYS}
    if option == "ekf_slam" and size == settings.LINKED:
        for kind, link in settings.LINKS.items():
            yield base | link, {"sightings": True, "link": kind}


def compose_experiment(seed: int, overrides: Mapping[str, Any]) -> Experiment:
    """The experiment of one arm in one world."""
    given = [f"{key}={value}" for key, value in overrides.items()]
    return Experiment.compose(["study=teams", f"seed={seed}", *given])


def drive(seed: int) -> dict[str, Array]:
    """True paths of a team, and its sightings as lines, for the figure."""
    robots = compose_experiment(seed, {}).recordings().robots
    lines = (sightings(robots, number)[1] for number in range(len(robots)))
    seen = {f"sightings_{number}": each.reshape(-1, 4) for number, each in enumerate(lines)}
    return drive_of(robots) | seen


def mrclam_rows(log: Path, n_frames: int | None = None) -> list[Row]:
    """Errors of each robot of MRCLAM 6 by EKF-SLAM: alone, in a team, and in one with sightings.

    The robots are calibrated as in the study of single robots, on the stretch that is not scored,
    and the same is believed of their slip, noise and gates.

    Parameters
    ----------
    n_frames
        Of each robot; None for all.
    """
    robots = [_calibrated(recording) for recording in mrclam.read_team(log).robots]
    team = Team.on_one_clock([own if n_frames is None else own.cut(n_frames) for own in robots])
    priors = list(map(known_start, team.robots))
    rows: list[Row] = []
    for arm, kind in zip(settings.MRCLAM_ARMS, settings.MRCLAM_LINKS, strict=True):
        seen = "robots" if arm == settings.MRCLAM_ARMS[-1] else None
        make = functools.partial(EkfSlam, robots=seen, **settings.MRCLAM_OPTIONS)
        found = run_team(make, team, priors, np.random.default_rng, Communication(kind=kind))
        for number, (own, (online, _)) in enumerate(zip(team.robots, found, strict=True)):
            scores = score(own, online, math.inf, CALIBRATED_S)
            rows.append({"robot": number + 1, "arm": arm, "ate_rmse_m": scores["ate_rmse_m"]})
    return rows


def _calibrated(recording: Recording) -> Recording:
    """The calibrated recording, with what its camera saw as if all robots carried it alike.

    One camera sees landmarks and robots, so the calibration by landmarks is that of sightings too.
    """
    found = calibrate_by_truth(recording)
    eyes = dict.fromkeys(("stereo", "robots"), found.sensors["stereo"])
    own = dataclasses.replace(found, sensors=eyes).apply_to(recording)
    for name in eyes:
        camera: Any = own.sensors[name]
        log = own.log(name)
        x, y, z = camera.points_in_base(log.values).T
        values = {**log.values, "points_in_camera": np.column_stack([-y, -z, x])}
        level = dataclasses.replace(camera, mount=Mount(z_m=0.0))
        own = own.with_log(name, dataclasses.replace(log, values=values), level)
    return own
