"""The study of GI9: the error of a team with and without sightings of one another.

A world is driven through once by five robots; a smaller team is the first of them. The arms share
everything but the sightings: recordings, starts, map, and the filter's stream.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from estimators.base import Estimate, Prior
from estimators.landmarks.ekf_slam import EkfSlam
from estimators.team import Communication, Kind, run_team
from experiments.evaluation.metrics import position_errors_m, rms
from experiments.judging.jobs import Tables, tables_of
from experiments.judging.results import Results
from experiments.judging.verdict import Profile
from experiments.runs.evaluate import evaluate
from experiments.runs.experiment import Experiment
from experiments.runs.row import Row
from experiments.runs.team import TeamExperiment
from experiments.studies.real_logs.logs import calibration_by_truth
from experiments.studies.real_logs.settings import CALIBRATED_S, DATA
from experiments.studies.teams import settings
from experiments.sweeps.collect import with_answers
from experiments.viewing.team_figure import sightings
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


def run(profile: Profile, out: Results, on_progress: Callable[[float], None]) -> None:
    """Run the study; write its tables, and the drive that the figure shows.

    Parameters
    ----------
    profile
        `quick`: two worlds.
    on_progress
        Called with the share of the work done.
    """
    jobs = list(team_jobs(profile))
    out.write_tables(**tables_of(rows_of, jobs, on_progress))
    if (log := mrclam_log()).exists():
        out.write_tables(mrclam=pd.DataFrame(mrclam_rows(log)))
    out.write_arrays("drive", **drive(settings.FIRST_SEED))


def team_jobs(profile: Profile) -> Iterator[tuple[int, str]]:
    """World and estimator of each job; the slower estimators run in fewer worlds."""
    for option, n_worlds in settings.WORLDS[profile].items():
        for seed in range(settings.FIRST_SEED, settings.FIRST_SEED + n_worlds):
            yield seed, option


def rows_of(seed: int, option: str) -> Tables:
    """Rows of an estimator's runs in one world, for each size of the team."""
    whole = TeamExperiment(_composed(seed, {})).recording()
    rows = []
    for size in settings.SIZES:
        for overrides, labels in _arms(size, option):
            made = pd.DataFrame(
                evaluate(_composed(seed, overrides), functools.partial(whole.first, size))
            )
            found = with_answers(made, list(_KEPT)).iloc[0]
            labels = {"seed": seed, "size": size, "filter": option, **labels}
            rows.append({**labels, **{_KEPT[name]: found[name] for name in _KEPT if name in found}})
    return {"errors": rows}


def _arms(size: int, option: str) -> Iterator[tuple[dict[str, Any], Row]]:
    """Overrides of each run of a team of this size, and its labels."""
    for used in (False, True):
        seen = "robots" if used else "null"
        base = {"team.size": size, "estimator": option, "estimator.robots": seen}
        if option == "fastslam":
            base["estimator.n_particles"] = settings.N_PARTICLES
        yield base, {"sightings": used, "link": settings.ALWAYS}
    if option == "ekf_slam" and size == settings.LINKED:
        for kind, link in settings.LINKS.items():
            yield base | link, {"sightings": True, "link": kind}


def _composed(seed: int, overrides: Mapping[str, Any]) -> Experiment:
    given = [f"{key}={value}" for key, value in overrides.items()]
    return Experiment.compose(["study=teams", f"seed={seed}", *given])


def _known(truth: Array, found: Estimate) -> tuple[Array, NDArray[np.bool_]]:
    """True poses where there are some and the estimate knows the robot's place; and which."""
    known = np.asarray(np.isfinite(truth).all(axis=1) & np.isfinite(found.means).all(axis=1))
    return truth[known], known


def drive(seed: int) -> dict[str, Array]:
    """True paths of a team, and its sightings as lines, for the figure."""
    robots = TeamExperiment(_composed(seed, {})).recording().robots
    world = robots[0].known_world
    arrays: dict[str, Array] = {"walls": world.walls, "wall_z_m": world.wall_z_m}
    for number, recording in enumerate(robots):
        arrays[f"truth_{number}"] = recording.known_truth.poses[:, :2]
        arrays[f"sightings_{number}"] = sightings(robots, number)[1].reshape(-1, 4)
    return arrays


def mrclam_log() -> Path:
    """Where MRCLAM 6 is looked for; it is not part of the project."""
    return DATA / "mrclam6" / "MRCLAM_Dataset6.tar.xz"


def mrclam_rows(log: Path, n_frames: int | None = None) -> list[Row]:
    """ATE of each robot of MRCLAM 6 by EKF-SLAM: alone, in a team, and in one with sightings.

    The robots are calibrated as in the study of single robots, on the stretch that is not scored,
    and the same is believed of their slip, noise and gates.

    Parameters
    ----------
    n_frames
        Of each robot; None for all.
    """
    robots = [_calibrated(recording) for recording in mrclam.read_team(log).robots]
    team = Team.on_one_clock([own if n_frames is None else own.cut(n_frames) for own in robots])
    priors = [
        Prior(own.robot, own.sensors, own.truth_at(own.frame_stamps[:1])[0], np.diag([1e-6] * 3))
        for own in team.robots
    ]
    rows: list[Row] = []
    for arm in settings.MRCLAM_ARMS:
        kind: Kind = "never" if arm == settings.MRCLAM_ARMS[0] else "always"
        sightings = "robots" if arm == settings.MRCLAM_ARMS[2] else None
        options: Any = settings.MRCLAM_OPTIONS
        found = run_team(
            functools.partial(EkfSlam, robots=sightings, **options),
            team,
            priors,
            lambda robot: np.random.default_rng(robot),
            Communication(kind),
        )
        for number, (own, (online, _)) in enumerate(zip(team.robots, found, strict=True)):
            truth, known = _known(own.truth_at(online.stamps), online)
            scored = online.stamps[known] >= own.frame_stamps[0] + CALIBRATED_S
            ate_m = rms(position_errors_m(truth, online.means[known])[scored])
            rows.append({"robot": number + 1, "arm": arm, "ate_rmse_m": ate_m})
    return rows


def _calibrated(recording: Recording) -> Recording:
    """The calibrated recording, with what its camera saw as if all robots carried it alike.

    One camera sees landmarks and robots, so the calibration by landmarks is that of sightings too.
    """
    found = calibration_by_truth(recording)
    eyes = dict.fromkeys(("stereo", "robots"), found.sensors["stereo"])
    own = dataclasses.replace(found, sensors=eyes).applied(recording)
    for name in eyes:
        camera: Any = own.sensors[name]
        log = own.log(name)
        x, y, z = camera.points_in_base(log.values).T
        values = {**log.values, "points_in_camera": np.column_stack([-y, -z, x])}
        level = dataclasses.replace(camera, mount=Mount(z_m=0.0))
        own = own.with_log(name, dataclasses.replace(log, values=values), level)
    return own
