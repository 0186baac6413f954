"""Runs of a team: the estimates of its robots, and the one row of them all."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.base import Answer, Estimate, Prior
from estimators.team import run_team
from experiments.runs.columns import REVISED, Average, average_of
from experiments.runs.objects import Objects
from experiments.runs.row import Outcome, Row, Status
from sim.arrays import Array
from sim.errors import required
from sim.sensors import RobotCamera
from sim.team import Team

_ADDED = ("stamps_scored", "stamps_left_out", "step_time_us")  # over the robots
_STREAMS = 100  # of a run's filters


def answers_of_team(
    experiment: Objects,
    team: Team,
    priors: Sequence[Prior],
    repeat: int,
    streams: Callable[[int], np.random.Generator],
    on_step: Callable[[int], None] | None = None,
) -> list[Answer]:
    """Online and revised estimate of each robot.

    A robot whose start is not known has no estimate until it is placed. The estimates share the
    processor time of the run.

    Parameters
    ----------
    repeat
        Which of the runs over the same team.
    streams
        Generators of the filters by number.
    on_step
        Called with the number of Frames done.
    """
    settings = required(experiment.team, "team must hold keys; choose study=teams")
    range_m = settings.communication.range_m
    answers = run_team(
        experiment.team_estimator,
        team,
        priors,
        lambda robot: streams(_STREAMS * repeat + robot),
        settings.communication,
        None if range_m is None else in_range(team, range_m),
        on_step,
    )
    if settings.starts == "known":
        return answers
    others = [(_placed(online), revised and _placed(revised)) for online, revised in answers[1:]]
    return [answers[0], *others]


def status_of_team(statuses: Sequence[Status]) -> Status:
    """The worst of the robots' statuses, which says whose it is."""
    rank = [list(Outcome).index(status.outcome) for status in statuses]
    number = int(np.argmax(rank))
    worst = statuses[number]
    detail = f"robot {number}: {worst.detail}" if worst.detail else ""
    return dataclasses.replace(worst, detail=detail)


def scores_of_team(team: Team, scores: Sequence[Row]) -> Row:
    """The one row of a team's run, of the scores of its robots.

    Errors are pooled by their squares over all stamps that count. Counts and times of a step add
    up; all else is averaged over the stamps. `worst_robot_rmse_m` comes from the best answers.
    """
    row: Row = {}
    for name in dict.fromkeys(name for own in scores for name in own):
        given = [own for own in scores if name in own]
        values = np.array([own[name] for own in given], np.float64)
        weights = np.array([own.get("stamps_scored", 1.0) for own in given], np.float64)
        if name in _ADDED or name.removeprefix(REVISED) in _ADDED:
            row[name] = float(values.sum())
        elif average_of(name) is Average.ERROR:
            row[name] = math.sqrt(np.average(values**2, weights=weights))
        else:
            row[name] = float(np.average(values, weights=weights))
    error = "ate_rmse_m"
    worst = [own.get(f"{REVISED}{error}", own.get(error)) for own in scores]
    known = [float(value) for value in worst if isinstance(value, float)]
    if known:
        row["worst_robot_rmse_m"] = float(np.max(known))
    row["n_sightings"] = sum(
        len(log["points_in_camera"])
        for robot in team.robots
        for name, log in robot.logs.items()
        if isinstance(robot.sensors[name], RobotCamera)
    )
    return row


def in_range(team: Team, range_m: float) -> NDArray[np.bool_]:
    """Which robots are within a distance of each other, (T, R, R) at each instant, by the truth."""
    stamps = np.unique(np.concatenate([recording.frame_stamps for recording in team.robots]))
    at: Array = np.stack([_where(recording, stamps) for recording in team.robots], axis=1)
    apart = at[:, :, None] - at[:, None]
    return np.asarray(np.hypot(apart[..., 0], apart[..., 1]) <= range_m)


def _where(recording: Any, stamps: Array) -> Array:
    """True positions (T, 2); before and after its recording a robot stands where it was."""
    truth = recording.known_truth.stamps
    return np.asarray(recording.truth_at(np.clip(stamps, truth[0], truth[-1]))[:, :2])


def _placed(estimate: Estimate) -> Estimate:
    """The estimate from its first pose on; as it is, if there is none."""
    known = np.isfinite(estimate.means).all(axis=1)
    kept = slice(int(np.argmax(known)), None)
    return dataclasses.replace(
        estimate,
        stamps=estimate.stamps[kept],
        means=estimate.means[kept],
        covariances=estimate.covariances[kept],
        step_seconds=estimate.step_seconds[kept],
    )
