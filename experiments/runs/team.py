"""Experiments of a team: its recordings, its estimates, and the one row of a run.

`recorded` gives what an experiment reads, be it of one robot or of a team.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimators.base import Answer, Estimate, Prior
from estimators.team import run_team
from experiments.runs.cache import cached
from experiments.runs.columns import REVISED, Average, average_of
from experiments.runs.experiment import Experiment
from experiments.runs.row import Outcome, Row, Status
from experiments.runs.schema import SIMULATED_KEYS
from experiments.runs.seeds import stream
from experiments.runs.team_settings import TeamSettings
from sim.arrays import Array
from sim.errors import InputError, required
from sim.recording import Recording
from sim.sensors import RobotCamera
from sim.simulate import Member, record_team
from sim.team import Team, load

_ADDED = ("stamps_scored", "stamps_left_out", "step_time_us")  # over the robots
_STREAMS = 100  # of a run's filters


@dataclass(frozen=True)
class TeamExperiment:
    """An experiment of several robots. Robot 0 has the random streams of a robot alone.

    Parameters
    ----------
    experiment
        Its `team` says who drives.

    Raises
    ------
    InputError
        If there is no key `team`, or one of its keys is missing, unknown, or makes no sense.
    """

    experiment: Experiment

    def __post_init__(self) -> None:
        for number in range(self.settings.size):
            self.experiment.of_robot(number)

    @property
    def settings(self) -> TeamSettings:
        """The key `team`."""
        return required(self.experiment.team, "team must hold keys; choose study=teams")

    def recording(self, on_progress: Callable[[float], None] | None = None) -> Team:
        """Read the team from its file, find it in the cache, or simulate it.

        Of a team from a file the first `team.size` robots are taken.
        """
        wanted, size = self.experiment.config["recording"], self.settings.size
        if isinstance(wanted, str):
            team = load(Path(wanted))
            if size > len(team):
                raise InputError(f"{wanted}: a team of {len(team)} robots; set team.size")
            return team if size == len(team) else team.first(size)
        if wanted is not None:
            raise InputError("recording: a team is simulated, or read from a file")
        simulate = functools.cache(lambda: self.record(on_progress))

        def of_robot(number: int) -> Recording:
            key = f"{self.experiment.recording_key}-{number}"
            found = cached(key, lambda: simulate().robots[number])
            # a file does not choose what code runs, but the configuration does
            return dataclasses.replace(found, sensors=self.experiment.of_robot(number).sensors())

        return Team(tuple(map(of_robot, range(size))))

    def record(self, on_progress: Callable[[float], None] | None = None) -> Team:
        """Simulate the team."""
        members = []
        for number in range(self.settings.size):
            own = self.experiment.of_robot(number)
            streams = {axis: stream(own.seed, axis, number) for axis in ("slip", "sensors")}
            config = {key: own.config[key] for key in SIMULATED_KEYS}
            what = own.robot(), own.sensors(), own.route(), streams, config, own.onboard
            members.append(Member(*what))
        simulation = self.experiment.config["simulation"]
        return record_team(
            self.experiment.world(),
            members,
            physics=simulation["physics"],
            rays=simulation["rays"],
            on_progress=on_progress,
        )

    def priors(self, team: Team) -> list[Prior]:
        """What is known of each robot at the start; each has a draw of its own."""
        priors = []
        for number, recording in enumerate(team.robots):
            prior = self.experiment.of_robot(number).prior(recording, number)
            if number and self.settings.starts == "unknown":
                prior = dataclasses.replace(prior, mean=None, covariance=None)
            priors.append(prior)
        return priors

    def run(
        self,
        team: Team,
        repeat: int = 0,
        streams: Callable[[int], np.random.Generator] | None = None,
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
            Generators of the filters by number; by default those of the axis `estimator/NAME`.
        on_step
            Called with the number of Frames done.
        """
        experiment, communication = self.experiment, self.settings.communication
        axis = f"estimator/{experiment.estimator_name}"
        own = streams or functools.partial(stream, experiment.seed, axis)
        contacts = None
        if communication.range_m is not None:
            contacts = in_range(team, communication.range_m)
        found = run_team(
            experiment.team_estimator,
            team,
            self.priors(team),
            lambda robot: own(_STREAMS * repeat + robot),
            communication,
            contacts,
            on_step,
        )
        if self.settings.starts == "known":
            return found
        placed = [(_placed(online), revised and _placed(revised)) for online, revised in found[1:]]
        return [found[0], *placed]


def recorded(
    experiment: Experiment, on_progress: Callable[[float], None] | None = None
) -> Recording | Team:
    """What an experiment reads: a recording, or those of a team."""
    if experiment.team is None:
        return experiment.recording(on_progress)
    return TeamExperiment(experiment).recording(on_progress)


def robots_of(recorded: Recording | Team) -> tuple[Recording, ...]:
    """The recording of each robot."""
    return recorded.robots if isinstance(recorded, Team) else (recorded,)


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
    up; all else is averaged over the stamps. `worst_robot_rmse_m` is of the best answers.
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
