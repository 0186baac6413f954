"""Builds what a configuration names: world, robots, estimators, recordings, priors."""

from __future__ import annotations

import copy
import dataclasses
import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self, cast

import numpy as np

from estimators.base import Estimator, Prior, TeamEstimator
from estimators.programs.host import Isolated
from experiments.evaluation.metrics import SCORED_EXTRAS
from experiments.runs.cache import fetch_or_make
from experiments.runs.calibration import read_calibrations
from experiments.runs.console import warn
from experiments.runs.dependencies.recorder import Digests, note_unloaded, recorded
from experiments.runs.key import recording_key
from experiments.runs.schema import (
    SIMULATED_KEYS,
    Config,
    PriorOptions,
    SimulationOptions,
    TeamSettings,
    robot_config,
)
from experiments.runs.seeds import stream
from experiments.runs.targets import make
from sim.arrays import Array
from sim.errors import InputError, blaming, require, required
from sim.options import build
from sim.people.walk import People
from sim.recording import Frame, Recording
from sim.robot.base import RobotGeometry, robot_from_config
from sim.sensors import Sensor, Sensors, sensors_from_config
from sim.sensors.base import RecordedSensor, sensor_settings
from sim.team import Team
from sim.worlds import grid_file
from sim.worlds.floor_plan import NoRoomError
from sim.worlds.world import World

OF_TEAMS = "ekf_slam, fastslam or smoother"


@dataclass(frozen=True)
class Objects:
    """A resolved configuration, and what it names.

    Attributes
    ----------
    config
        Resolved configuration, plain values.
    choices
        Name of the chosen option of each configuration group.
    own_estimator
        An object in place of the configured estimator; see `Experiment.using`.
    """

    config: Config
    choices: Mapping[str, str] = field(default_factory=dict)
    own_estimator: Estimator | None = None

    @property
    def seed(self) -> int:
        """Seed of every stream of randomness but the world's."""
        return int(self.config["seed"])

    @property
    def estimator_name(self) -> str:
        """The chosen option, or the class of an estimator without one."""
        return self.choices.get("estimator") or str(self.config["estimator"]["_target_"])

    @property
    def recording_key(self) -> str:
        """Digest of the settings that decide the recording's bits, or of its file."""
        return recording_key(self.config)

    @property
    def isolated(self) -> bool:
        """Whether the estimator runs in a child process; a program is one anyway."""
        return bool(self.config.get("isolated")) and "command" not in self.config["estimator"]

    def world(self) -> World:
        """Make the world, from its own stream; if its objects do not fit, it is drawn again."""
        rng = stream(self.config["world_seed"], "world", key="world_seed")
        tries_left = 5
        while True:
            try:
                made = make(self.config["world"], "world", rng=rng)
                world: World = made if isinstance(made, World) else made.build(rng)
                return world
            except NoRoomError:
                tries_left -= 1
                if not tries_left:
                    raise

    def robot(self) -> Any:
        """Make the true robot."""
        return robot_from_config(self.config["robot"])

    def sensors(self) -> dict[str, Sensor]:
        """Make the sensors."""
        return sensors_from_config(self.config["sensors"])

    def estimator(self) -> Estimator:
        """Make the estimator: anything with `reset` and `step`."""
        settings = copy.deepcopy(self.config["estimator"])
        if self.isolated:
            target = str(self.config["estimator"].get("_target_"))
            note_unloaded(target.rpartition(".")[0], self.config["estimator"])
            return Isolated(settings, [*SCORED_EXTRAS, *self.config["keep"]])
        estimator: Estimator = self.own_estimator or make(settings, "estimator")
        for method in ("reset", "step"):
            require(
                callable(getattr(estimator, method, None)),
                f"estimator {type(estimator).__name__} has no method {method}; "
                "see estimators/base.py for the protocol",
            )
        return estimator

    def team_estimator(self) -> TeamEstimator:
        """Make the estimator of a team: anything with `reset_team` and `step_team`."""
        estimator: Any = self.estimator()
        require(
            hasattr(estimator, "reset_team") and hasattr(estimator, "step_team"),
            f"estimator={self.estimator_name} localizes one robot; a team takes {OF_TEAMS}",
        )
        return cast(TeamEstimator, estimator)

    @property
    def team(self) -> TeamSettings | None:
        """The key `team` of a study of several robots; None of one robot."""
        given = self.config.get("team")
        return None if given is None else build(TeamSettings, given, "team")

    @property
    def size(self) -> int:
        """How many robots drive."""
        return 1 if self.team is None else self.team.size

    def of_robot(self, number: int) -> Self:
        """The experiment of one robot of the team, alone, with what it has of its own."""
        if self.team is None:
            return self
        return dataclasses.replace(self, config=robot_config(self.config, self.team, number))

    def route(self) -> Any:
        """Make the route: anything with `start`, as in `sim.simulate.Route`."""
        return make(self.config["route"], "route")

    # What they record

    def simulate_team(
        self,
        on_progress: Callable[[float], None] | None = None,
        streams: Mapping[str, np.random.Generator] | None = None,
    ) -> Team:
        """Simulate the recordings. Robot 0 has the random streams of a robot alone.

        Parameters
        ----------
        on_progress
            Called with the seconds simulated.
        streams
            Generators `slip` and `sensors` of each robot, in place of the seed's own.
        """
        from sim.simulate import Member, record_team

        members = []
        for number in range(self.size):
            own = self.of_robot(number)
            config = {key: own.config[key] for key in SIMULATED_KEYS}
            drawn = streams or {a: stream(own.seed, a, number) for a in ("slip", "sensors")}
            members.append(
                Member(own.robot(), own.sensors(), own.route(), drawn, config, own.onboard)
            )
        simulation = dataclasses.asdict(
            build(SimulationOptions, self.config["simulation"], "simulation")
        )
        people = build(People, self.config["people"], "people")
        passers_by = people, stream(self.seed, "people")
        return record_team(
            self.world(), members, **simulation, passers_by=passers_by, on_progress=on_progress
        )

    def simulate(
        self,
        on_progress: Callable[[float], None] | None = None,
        streams: Mapping[str, np.random.Generator] | None = None,
    ) -> Recording:
        """Simulate the recording of one robot, as `simulated` does."""
        self._check_one_robot()
        return self.simulate_team(on_progress, streams).only

    def recordings(self, on_progress: Callable[[float], None] | None = None) -> Team:
        """Read the recordings, find them in the cache, or simulate them.

        Of a team from a file the first `team.size` robots are taken. A mapping in place of a path
        names a function that makes a recording.
        """
        wanted = self.config["recording"]
        if isinstance(wanted, dict):
            require(self.team is None, "recording: a team is simulated, or read from a file")
            made = make(wanted, "recording", config=self.config)
            require(
                isinstance(made, Recording),
                f"recording: {wanted['_target_']} must return a Recording, "
                f"got {type(made).__name__}",
            )
            return self._calibrated(Team((made,)))
        if wanted is not None:
            return self._loaded(Path(wanted))

        @functools.cache
        def simulate() -> tuple[Team, Digests]:
            with recorded(__name__) as seen:
                team = self.simulate_team(on_progress)
            return team, seen.digests()

        def one(number: int) -> tuple[Recording, Digests]:
            team, dependencies = simulate()
            return team.robots[number], dependencies

        def of_robot(number: int) -> Recording:
            key = f"{self.recording_key}-{number}"
            found = fetch_or_make(key, functools.partial(one, number))
            # a file does not choose what code runs, but the configuration does
            return dataclasses.replace(found, sensors=self.of_robot(number).sensors())

        return Team(tuple(map(of_robot, range(self.size))))

    def recording(self, on_progress: Callable[[float], None] | None = None) -> Recording:
        """The recording of one robot, as `recordings` gives it."""
        self._check_one_robot()
        return self.recordings(on_progress).only

    def _check_one_robot(self) -> None:
        require(
            self.team is None,
            "team: a recording holds one robot; `estima record` and `estima run` take teams",
        )

    def _loaded(self, path: Path) -> Team:
        """The robots of a file, as they are believed to be."""
        from sim.formats.detect import read_all  # here, so that it counts where a log is read

        team = read_all([path])
        if self.team is not None:
            require(self.size <= len(team), f"{path}: a team of {len(team)} robots; set team.size")
            return self._calibrated(team if self.size == len(team) else team.first(self.size))
        try:
            recording = team.only
        except InputError as error:
            raise InputError(f"{path}: {error}") from error
        self._compare_slip(recording)
        return self._calibrated(Team((self._with_classes(recording),)))

    def check_size(self, team: Team) -> None:
        """Check that there is a recording for each robot of the experiment.

        Raises
        ------
        InputError
            If there are more or fewer.
        """
        require(
            self.team is not None or len(team) == 1,
            "the recording holds a team; choose study=teams",
        )
        require(
            len(team) == self.size,
            f"a recording of {len(team)} robots, and team.size is {self.size}",
        )

    def onboard(
        self, world: World, robot: RobotGeometry, sensors: Sensors, start: Array
    ) -> Callable[[Frame], Array]:
        """Start the estimator that the route's feedback names; it knows the start and the map."""
        estimator = self._steering()
        prior = Prior(robot, sensors, start.copy(), np.zeros((3, 3)), world.known)
        with blaming("route.feedback"):
            estimator.reset(prior, stream(self.config["seed"], "onboard"))
        return lambda frame: estimator.step(frame).mean

    def _steering(self) -> Estimator:
        """Make the estimator that the route's feedback names."""
        estimator: Estimator = make(self.config["route"]["feedback"], "route.feedback")
        require(
            all(callable(getattr(estimator, name, None)) for name in ("reset", "step")),
            "route.feedback names no estimator: it has no reset and step",
        )
        return estimator

    def _calibrated(self, team: Team) -> Team:
        """Return the recordings as the calibration has them: each by its own, or all by one."""
        found = read_calibrations(self.config["calibration"])
        if not found:
            return team
        require(
            len(found) in (1, len(team)),
            f"calibration: {len(found)} files for a team of {len(team)}; give one, or one a robot",
        )
        own = found * len(team) if len(found) == 1 else found
        moved = [each.apply_to(robot) for each, robot in zip(own, team.robots, strict=True)]
        return Team.on_one_clock(moved)

    def _with_classes(self, recording: Recording) -> Recording:
        """Return the recording with the classes of its sensors that the configuration names too."""
        again = {
            name: sensor_settings(sensor)
            for name, sensor in recording.sensors.items()
            if isinstance(sensor, RecordedSensor)
            and (self.config["sensors"].get(name) or {}).get("_target_") == sensor.target
        }
        return dataclasses.replace(
            recording, sensors={**recording.sensors, **sensors_from_config(again)}
        )

    def _compare_slip(self, recording: Recording) -> None:
        """Warn if kr or kl are not those that the recording was made with."""
        made_with, believed = recording.config.get("robot"), self.config["robot"]
        if not isinstance(made_with, dict):  # of a log of many robots, the number of one
            return
        for key in ("kr", "kl"):
            asked = key in made_with and key in self.config["estimator"]
            if asked and made_with[key] != believed[key]:
                warn(
                    f"the recording was made with robot.{key}={made_with[key]:g}; "
                    f"{believed[key]:g} is believed unless robot.{key} or estimator.{key} is set"
                )

    # What is known at the start

    def prior(self, recording: Recording, number: int = 0) -> Prior:
        """Return what the estimator knows at the start of the robot of this number.

        Raises
        ------
        InputError
            If a start pose is wanted, and the truth does not cover the first Frame.
        """
        given = build(PriorOptions, self.config["prior"], "prior")
        robot = RobotGeometry(
            given.wheel_radius_m or recording.robot.wheel_radius_m,
            given.track_m or recording.robot.track_m,
        )
        known_map = self._map(recording)
        if given.start == "global":
            return Prior(robot, recording.sensors, map=known_map)
        sigma = np.array([given.sigma_position_m] * 2 + [given.sigma_heading_rad])
        start = np.zeros(3) if recording.truth is None else _true_start(recording)
        offset = sigma * stream(self.config["seed"], "prior", number).standard_normal(3)
        return Prior(robot, recording.sensors, start + offset, np.diag(np.square(sigma)), known_map)

    def priors(self, team: Team) -> list[Prior]:
        """What is known of each robot at the start; each has a draw of its own."""
        priors = []
        for number, recording in enumerate(team.robots):
            prior = self.of_robot(number).prior(recording, number)
            if number and self.team is not None and self.team.starts == "unknown":
                prior = dataclasses.replace(prior, mean=None, covariance=None)
            priors.append(prior)
        return priors

    def _map(self, recording: Recording) -> Any:
        """Map of the prior: none, the recording's world, a grid, or what a function makes."""
        wanted = self.config["prior"]["map"]
        if isinstance(wanted, dict):
            return make(wanted, "prior.map", config=self.config, recording=recording)
        if wanted == "none":
            return None
        if is_grid_file(wanted):
            return grid_file.read_grid(wanted)
        missing = "prior.map=world, but the recording has no map; set prior.map=none"
        return required(recording.world, missing).as_map()


def _true_start(recording: Recording) -> Array:
    """True pose (3,) at the first Frame."""
    begin_s = float(recording.frame_stamps[0])
    start: Array = recording.truth_at(recording.frame_stamps[:1])[0]
    spans = recording.known_truth.stamps[[0, -1]]
    require(
        bool(np.isfinite(start).all()),
        f"the first Frame is at {begin_s:.2f} s, and the truth spans {spans[0]:.2f} to "
        f"{spans[1]:.2f} s: no start pose is known; have `estima convert` cut the log from "
        f"{math.ceil(max(float(spans[0]) - begin_s, 0.0) * 100) / 100:.2f} s on, or set "
        "prior.start=global",
    )
    return start


def is_grid_file(known_map: Any) -> bool:
    """Whether a prior's map is a grid's file."""
    return isinstance(known_map, str) and Path(known_map).suffix in grid_file.SUFFIXES
