"""A team of a configuration: the key `team` of a study beside the keys of one robot."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from estimators.base import Prior
from estimators.team import Answer, Communication, TeamEstimator, run_team
from experiments.runs.experiment import SIMULATED_KEYS, Config, Experiment
from experiments.runs.seeds import stream
from sim.arrays import Array
from sim.errors import InputError, require
from sim.settings import build
from sim.simulate import Member, record_team
from sim.team import Team

_OWN = ("robot", "sensors", "route")  # what a robot of a team may have of its own


@dataclass(frozen=True)
class TeamSettings:
    """The key `team`.

    Attributes
    ----------
    size
        How many of the robots drive.
    starts
        `known`: each robot has a prior. `unknown`: robot 0 alone has one.
    robots
        For each robot, keys of `robot`, `sensors` and `route` in which it differs.
    communication
        See `estimators.team.Communication`.
    """

    size: int
    starts: Literal["known", "unknown"]
    robots: tuple[Mapping[str, Any], ...]
    communication: Communication


@dataclass(frozen=True)
class TeamExperiment:
    """An experiment of several robots. Robot 0 has the random streams of a robot alone.

    Parameters
    ----------
    experiment
        Its `team` says who drives; see `TeamSettings`.

    Raises
    ------
    InputError
        If a key of `team` is missing, unknown, or makes no sense.
    """

    experiment: Experiment

    def __post_init__(self) -> None:
        settings = self.settings
        require(
            settings.starts in ("known", "unknown"),
            f"team.starts must be known or unknown, got {settings.starts!r}",
        )
        require(
            1 <= settings.size <= len(settings.robots),
            f"team.size must be from 1 to the {len(settings.robots)} of team.robots, "
            f"got {settings.size}",
        )
        for number in range(settings.size):
            self.of_robot(number)

    @property
    def settings(self) -> TeamSettings:
        """The key `team`."""
        given = self.experiment.config.get("team")
        require(isinstance(given, Mapping), "team must hold keys; choose study=teams")
        settings = build(TeamSettings, cast(Config, given), "team")
        communication = settings.communication
        if not isinstance(communication, Communication):
            communication = build(Communication, communication, "team.communication")
        return dataclasses.replace(
            settings, robots=tuple(settings.robots), communication=communication
        )

    def of_robot(self, number: int) -> Experiment:
        """The experiment of one of the robots."""
        config = copy.deepcopy(self.experiment.config)
        for key, values in self.settings.robots[number].items():
            if key not in _OWN:
                raise InputError(f"unknown key team.robots[{number}].{key}; known: {_OWN}")
            for name in values:
                known = ", ".join(config[key])
                where = f"team.robots[{number}].{key}.{name}"
                require(name in config[key], f"unknown key {where}; known: {known}")
            config[key] = {**config[key], **values}
        return dataclasses.replace(self.experiment, config=config)

    def record(self) -> Team:
        """Simulate the team."""
        members = []
        for number in range(self.settings.size):
            own = self.of_robot(number)
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
        )

    def priors(self, team: Team) -> list[Prior]:
        """What is known of each robot at the start; each has a draw of its own."""
        priors = []
        for number, recording in enumerate(team.robots):
            prior = self.of_robot(number).prior(recording, number)
            if number and self.settings.starts == "unknown":
                prior = dataclasses.replace(prior, mean=None, covariance=None)
            priors.append(prior)
        return priors

    def run(self, team: Team, index: int = 0) -> list[Answer]:
        """Online and revised estimate of each robot.

        Parameters
        ----------
        index
            Which of the runs over the same team.
        """
        communication = self.settings.communication
        contacts = None
        if communication.range_m is not None:
            contacts = in_range(team, communication.range_m)
        axis = f"estimator/{self.experiment.estimator_name}"
        return run_team(
            self._estimator,
            team,
            self.priors(team),
            lambda robot: stream(self.experiment.seed, axis, 100 * index + robot),
            communication,
            contacts,
        )

    def _estimator(self) -> TeamEstimator:
        estimator: Any = self.experiment.estimator()
        require(
            hasattr(estimator, "step_team"),
            f"estimator={self.experiment.estimator_name} is of one robot; a team takes ekf_slam, "
            "fastslam or smoother",
        )
        return cast(TeamEstimator, estimator)


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
