"""A resolved configuration and the objects it names. Nothing else reads configuration keys."""

from __future__ import annotations

import dataclasses
import hashlib
import inspect
import json
import math
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np
from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import InterpolationKeyError

from estimators.base import Estimator, Prior
from estimators.team import TeamEstimator
from experiments.runs import paths
from experiments.runs.cache import cached, key_of
from experiments.runs.calibration import read_calibration
from experiments.runs.row import Row
from experiments.runs.seeds import stream
from experiments.runs.targets import checked, make, targets
from experiments.runs.team_settings import TeamSettings, own_config, team_settings
from experiments.runs.version import code_version, source_digest, version_with
from sim.arrays import Array
from sim.errors import InputError, blaming, require, required
from sim.files import write_text
from sim.recording import Frame, Recording, load
from sim.robot.drive import DifferentialDrive, RobotGeometry
from sim.sensors import Sensor, Sensors, sensors_from_config
from sim.sensors.base import RecordedSensor, sensor_settings
from sim.settings import build, find
from sim.worlds import grid_file
from sim.worlds.grid import OccupancyGrid
from sim.worlds.world import World
from sim.yaml_file import read_yaml

Config = dict[str, Any]
GROUPS = ("world", "robot", "sensors", "route", "estimator")
_MAPPINGS = (*GROUPS, "simulation", "prior", "scoring")
SIMULATED_KEYS = ("world", "robot", "sensors", "route", "simulation", "seed", "world_seed")
_TEAM_KEYS = ("size", "robots")  # of the key `team`, those that decide what is read
_KEYS = (
    *_MAPPINGS,
    *("seed", "world_seed", "repeats", "recording", "calibration", "name", "picture", "keep"),
    *("simulation.physics", "simulation.rays"),
    *("prior.start", "prior.sigma_position_m", "prior.sigma_heading_rad"),
    *("prior.wheel_radius_m", "prior.track_m", "prior.map"),
    *("scoring.longest_gap_s", "scoring.after_s"),
)
_NOT_IN_KEY = ("name", "picture", "recording")
_READ_OF_HYDRA = ("hydra/launcher", "hydra.launcher", "hydra.searchpath")
_OF_TEAMS = "ekf_slam, fastslam or smoother"
_PHYSICS = ("bullet", "kinematic")
_RAYS = ("bullet", "exact")


@dataclass(frozen=True)
class Experiment:
    """A world, a robot, its sensors and route, or a recording of them; and an estimator.

    Attributes
    ----------
    config
        Resolved configuration, plain values.
    choices
        Name of the chosen option of each configuration group.
    own_estimator
        An object in place of the configured estimator; see `using`.
    """

    config: Config
    choices: Mapping[str, str] = field(default_factory=dict)
    own_estimator: Estimator | None = None

    @classmethod
    def compose(cls, overrides: Sequence[str] = ()) -> Experiment:
        """Compose an experiment from Hydra's overrides, such as `world=office seed=3`."""
        with initialize_config_dir(str(paths.CONF), version_base="1.3"):
            return cls.resolved(*composed(with_study_file(overrides)))

    @classmethod
    def resolved(cls, cfg: DictConfig, choices: Mapping[str, str]) -> Experiment:
        """Resolve a composed configuration.

        Raises
        ------
        InputError
            If a key is missing, or is no mapping where it must be one.
        """
        _believe(cfg)
        try:
            config: Config = OmegaConf.to_container(cfg, resolve=True)  # type: ignore[assignment]
        except InterpolationKeyError as error:
            raise InputError(
                f"{error.full_key} follows a key that is missing: {str(error).splitlines()[0]}; "
                f"keep that key, or set {error.full_key} too"
            ) from error
        for of_sweeps in ("sweeps", "tune"):
            config.pop(of_sweeps, None)
        _check_shape(config)
        simulation = config["simulation"]
        if simulation["rays"] is None:
            kinematic = simulation["physics"] == "kinematic"  # it has no engine to cast rays
            simulation["rays"] = "exact" if kinematic else "bullet"
        return cls(config, {group: str(choices.get(group)) for group in GROUPS})

    def replaced(self, **values: Any) -> Experiment:
        """Return the experiment with other values of top-level keys, such as `seed=3`."""
        return dataclasses.replace(self, config={**self.config, **values})

    def using(self, estimator: Estimator) -> Experiment:
        """Return the experiment with an estimator that is not an option of the configuration."""
        kind = type(estimator)
        return dataclasses.replace(
            self.replaced(estimator={"class": f"{kind.__module__}.{kind.__qualname__}"}),
            choices={**self.choices, "estimator": kind.__name__},
            own_estimator=estimator,
        )

    def with_estimator(self, **settings: Any) -> Experiment:
        """Return the experiment with other values of keys of its estimator."""
        return self.replaced(estimator={**self.config["estimator"], **settings})

    def option(self, name: str, default: Any = None) -> Any:
        """An option of the estimator; `default` if it has none of this name."""
        return self.config["estimator"].get(name, default)

    def over(self, recording: Recording) -> Experiment:
        """Return the experiment over a recording in memory, identified by its checksum."""
        require(
            self.config["calibration"] is None,
            "calibration is for recording=FILE; of a recording in memory take "
            "read_calibration(FILE).applied(recording)",
        )
        self._compare_slip(recording)
        return self.replaced(recording={"checksum": recording.checksum})

    # What a run is called, and where its rows go

    @property
    def name(self) -> str:
        """Folder of the rows in results/runs."""
        return str(self.config["name"])

    @property
    def estimator_name(self) -> str:
        """The chosen option, or the class of an estimator without one."""
        return self.choices.get("estimator") or str(self.config["estimator"]["_target_"])

    @property
    def believed_slip(self) -> tuple[float, float] | None:
        """The kr and kl that the estimator believes, m; None if it has no such options."""
        settings = self.config["estimator"]
        return (settings["kr"], settings["kl"]) if {"kr", "kl"} <= set(settings) else None

    @property
    def seed(self) -> int:
        """Seed of every stream of randomness but the world's."""
        return int(self.config["seed"])

    @property
    def repeats(self) -> int:
        """Runs of the estimator over the recording."""
        return int(self.config["repeats"])

    @property
    def keep(self) -> list[str]:
        """Belief extras to record."""
        return list(self.config["keep"])

    @property
    def scoring(self) -> dict[str, float]:
        """Options of `experiments.evaluation.metrics.score`."""
        return {name: float(value) for name, value in self.config["scoring"].items()}

    @property
    def picture(self) -> bool:
        """Whether a single run is drawn."""
        return bool(self.config["picture"])

    @property
    def rows_folder(self) -> Path:
        """Folder of the rows.

        Raises
        ------
        InputError
            If the name is not one word.
        """
        return rows_folder(self.config["name"])

    @property
    def key(self) -> str:
        """Digest of what decides the rows: configuration, recording, map, files named, code.

        It is the sum of a digest for each leaf, and one of files and code, modulo 2^64. So the
        keys of a product of values are sums too, and a sweep of a million runs knows them at once.
        """
        settings = {key: value for key, value in self.config.items() if key not in _NOT_IN_KEY}
        files = files_digest(self.config["prior"].get("map"))
        files |= files_of_options(self.config["estimator"])
        files |= files_digest(self.config.get("calibration"))
        total = leaf_digest((), [self._recording_sources(), files, self._code_version()])
        total += sum(leaf_digest(leaf, value) for leaf, value in _leaves(settings))
        return f"{total % 2**64:016x}"

    @property
    def recording_key(self) -> str:
        """Digest of what decides the recording's bits: its settings, or a file's; and the code."""
        return key_of(self._recording_settings())

    def labels(self, checksum: str) -> Row:
        """Columns that state a row's origin: choices, keys, versions, the recording's checksum.

        Settings that did not make the recording have no column.
        """
        applied = self._applied()
        brought = ("world", "sensors", "route") if self.config["recording"] is not None else ()
        choices = {g: name for g, name in self.choices.items() if g in applied and g not in brought}
        return {
            **{f"choice.{group}": name for group, name in choices.items()},
            **_flat({k: v for k, v in applied.items() if k not in ("keep", "picture")}),
            "repeat": 0,
            "run_key": self.key,
            "code_version": self._code_version(),
            "recording_checksum": checksum,
        }

    def _applied(self) -> Config:
        """Settings without those of a simulation that a recording from a file takes the place of.

        A function that makes the recording or the map may read all of them.
        """
        places = (self.config["recording"], self.config["prior"].get("map"))
        made = any(isinstance(place, dict) and "_target_" in place for place in places)
        if self.config["recording"] is None or made:
            return self.config
        unused = set(SIMULATED_KEYS) - {"seed"}
        return {key: value for key, value in self.config.items() if key not in unused}

    def _code_version(self) -> str:
        return version_with(targets(self._applied()), self.config["estimator"].get("command"))

    # What it names

    def check(self) -> None:
        """Find what is wrong or does not fit together, before any run.

        Raises
        ------
        InputError
            Naming the key, and the remedy.
        """
        config = self.config
        _check_shape(config)
        repeats, keep = config["repeats"], config["keep"]
        if isinstance(repeats, bool) or not isinstance(repeats, int) or repeats < 1:
            raise InputError(f"repeats must be a whole number from 1 on, got {repeats!r}")
        if not (isinstance(keep, list) and all(isinstance(key, str) for key in keep)):
            raise InputError(f"keep must be a list of names, such as [ess], got {keep!r}")
        self.robot()
        self.sensors()
        self.route()
        checked(config["world"], "world", ("rng",))
        stream(config["seed"], "slip")
        stream(config["world_seed"], "world", key="world_seed")
        self._check_simulation()
        self._check_prior()
        self._check_scoring()
        self._check_team()
        self._check_needs()
        self._check_map()

    def _check_simulation(self) -> None:
        simulation = self.config["simulation"]
        for key, allowed in (("physics", _PHYSICS), ("rays", _RAYS)):
            if simulation[key] not in allowed:
                raise InputError(
                    f"simulation.{key} must be {' or '.join(allowed)}, got {simulation[key]!r}"
                )
        if simulation["physics"] == "kinematic" and simulation["rays"] == "bullet":
            raise InputError("simulation.rays=bullet needs the engine; set simulation.rays=exact")

    def _check_prior(self) -> None:
        settings = self.config["prior"]
        start, known_map = settings["start"], settings["map"]
        if start not in ("tracking", "global"):
            raise InputError(f"prior.start must be tracking or global, got {start!r}")
        for key in ("sigma_position_m", "sigma_heading_rad"):
            sigma = settings[key]
            number = isinstance(sigma, (int, float)) and not isinstance(sigma, bool)
            if not (number and 0.0 <= sigma < math.inf):
                raise InputError(f"prior.{key} must be zero or a positive number, got {sigma!r}")
        believed = {key: settings[key] for key in ("wheel_radius_m", "track_m")}
        build(RobotGeometry, {k: 1.0 if v is None else v for k, v in believed.items()}, "prior")
        if isinstance(known_map, dict):
            checked(known_map, "prior.map", ("config", "recording"))
        elif known_map not in ("none", "world") and not _is_grid_file(known_map):
            raise InputError(
                "prior.map must be none, world, a grid's .yaml file or a mapping with _target_, "
                f"got {known_map!r}"
            )

    def _check_scoring(self) -> None:
        for key, value in self.config["scoring"].items():
            number = isinstance(value, (int, float)) and not isinstance(value, bool)
            if not (number and value >= 0.0):
                raise InputError(
                    f"scoring.{key} must be zero or a positive number of seconds, got {value!r}"
                )

    def _check_needs(self) -> None:
        """Check that the estimator gets the sensors and the map that it needs."""
        settings = self.config["estimator"]
        estimator = self.own_estimator or checked(settings, "estimator")
        if str(settings.get("_target_")).startswith("estimators."):
            estimator = self.estimator()  # its values too; one from elsewhere may take long to make
        needs = frozenset(getattr(estimator, "needs", ()))
        if self.config["recording"] is None:
            self._check_sensors(f"estimator={self.estimator_name}", needs - {"map"}, settings)
            onboard = self.config["route"].get("feedback")
            if isinstance(onboard, dict):
                steering = getattr(self._steering(), "needs", ())
                self._check_sensors("route.feedback", frozenset(steering) - {"map"}, onboard)
        mapped = self.config["prior"]["map"] != "none" or settings.get("map_path")
        if "map" in needs and not mapped:
            raise InputError(
                f"estimator={self.estimator_name} needs a map; set prior.map=world, or a mapping "
                "with _target_"
            )

    def _check_map(self) -> None:
        """Check that a grid can be read, and that the estimator can use one."""
        known_map, settings = self.config["prior"]["map"], self.config["estimator"]
        if not _is_grid_file(known_map):
            return
        grid_file.read_grid(known_map)
        estimator = self.own_estimator or checked(settings, "estimator")
        kinds = getattr(estimator, "maps", None)
        if kinds and OccupancyGrid not in kinds and not settings.get("map_path"):
            names = " or ".join(kind.__name__ for kind in kinds)
            raise InputError(
                f"estimator={self.estimator_name} takes a {names}, and prior.map={known_map} is an "
                "occupancy grid"
            )

    def _check_team(self) -> None:
        """Check each robot of a team, and what is of one robot only."""
        team = self.team
        if team is None:
            return
        kind = find(self.config["estimator"].get("_target_"), "estimator")
        require(
            not inspect.isclass(kind) or hasattr(kind, "step_team"),
            f"estimator={self.estimator_name} is of one robot; a team takes {_OF_TEAMS}",
        )
        settings = self.config["estimator"]
        if settings.get("robots") is not None and self.config["recording"] is None:
            self._check_sensors(f"estimator={self.estimator_name}", ["robots"], settings)
        for number in range(team.size):
            own = self.of_robot(number)
            try:
                own.robot(), own.sensors(), own.route()
            except InputError as error:
                raise InputError(f"team.robots[{number}]: {error}") from error
        require(
            self.config["prior"]["start"] == "tracking",
            "prior.start=global: the start of robot 0 must be known to a team; those of the "
            "others may be unknown (team.starts)",
        )
        for key in ("keep", "calibration"):
            require(not self.config[key], f"{key} is of one robot; leave it out for a team")

    def _check_sensors(self, who: str, needs: Iterable[str], settings: Config) -> None:
        """Check that the robot has the sensors that an estimator needs."""
        has = {name for name, sensor in self.config["sensors"].items() if sensor is not None}
        for need in needs:
            # an option of the estimator says how the sensor is called
            names = [settings.get(option, option) for option in need.split("|")]
            if not has.intersection(names):
                presets = ", ".join(_presets_with(names))
                remedy = f"try sensors={presets}" if presets else f"add sensors.{names[0]}"
                raise InputError(
                    f"{who} needs a sensor {' or '.join(names)}, and "
                    f"sensors={self.choices.get('sensors')} has none; {remedy}"
                )

    def world(self) -> World:
        """Make the world, from its own stream."""
        rng = stream(self.config["world_seed"], "world", key="world_seed")
        world: World = make(self.config["world"], "world", rng=rng)
        return world

    def robot(self) -> DifferentialDrive:
        """Make the true robot."""
        return build(DifferentialDrive, self.config["robot"], "robot")

    def sensors(self) -> dict[str, Sensor]:
        """Make the sensors."""
        return sensors_from_config(self.config["sensors"])

    def estimator(self) -> Estimator:
        """Make the estimator: anything with `reset` and `step`."""
        estimator: Estimator = self.own_estimator or make(self.config["estimator"], "estimator")
        for method in ("reset", "step"):
            if not callable(getattr(estimator, method, None)):
                raise InputError(
                    f"estimator {type(estimator).__name__} has no method {method}; "
                    "see estimators/base.py for the protocol"
                )
        return estimator

    def team_estimator(self) -> TeamEstimator:
        """Make the estimator of a team: anything with `reset_team` and `step_team`."""
        estimator: Any = self.estimator()
        require(
            hasattr(estimator, "reset_team") and hasattr(estimator, "step_team"),
            f"estimator={self.estimator_name} is of one robot; a team takes {_OF_TEAMS}",
        )
        return cast(TeamEstimator, estimator)

    @property
    def team(self) -> TeamSettings | None:
        """The key `team` of a study of several robots; None of one robot."""
        given = self.config.get("team")
        return None if given is None else team_settings(given)

    def of_robot(self, number: int) -> Experiment:
        """The experiment of one robot of the team, alone, with what it has of its own."""
        team = required(self.team, "team: this experiment is of one robot")
        return dataclasses.replace(self, config=own_config(self.config, team, number))

    def route(self) -> Any:
        """Make the route: anything with `start`, as in `sim.simulate.Route`."""
        return make(self.config["route"], "route")

    def simulate(
        self,
        on_progress: Callable[[float], None] | None = None,
        streams: Mapping[str, np.random.Generator] | None = None,
    ) -> Recording:
        """Simulate the recording.

        Parameters
        ----------
        on_progress
            Called with the seconds simulated.
        streams
            Generators `slip` and `sensors`, in place of the seed's own.
        """
        from sim.simulate import record

        self._check_one_robot()
        self._check_simulation()
        return record(
            self.world(),
            self.robot(),
            self.sensors(),
            self.route(),
            streams or {axis: stream(self.config["seed"], axis) for axis in ("slip", "sensors")},
            physics=self.config["simulation"]["physics"],
            rays=self.config["simulation"]["rays"],
            config={key: self.config[key] for key in SIMULATED_KEYS},
            on_progress=on_progress,
            onboard=self.onboard,
        )

    def onboard(
        self, world: World, robot: RobotGeometry, sensors: Sensors, start: Array
    ) -> Callable[[Frame], Array]:
        """Start the estimator that the route's feedback names; it knows the start and the map."""
        estimator = self._steering()
        prior = Prior(robot, sensors, start.copy(), np.zeros((3, 3)), world)
        with blaming("route.feedback"):
            estimator.reset(prior, stream(self.config["seed"], "onboard"))
        return lambda frame: estimator.step(frame).mean

    def _steering(self) -> Estimator:
        """Make the estimator that the route's feedback names."""
        estimator: Estimator = make(self.config["route"]["feedback"], "route.feedback")
        whole = all(callable(getattr(estimator, name, None)) for name in ("reset", "step"))
        require(whole, "route.feedback names no estimator: it has no reset and step")
        return estimator

    def recording(self, on_progress: Callable[[float], None] | None = None) -> Recording:
        """Read the recording, find it in the cache, or simulate it.

        A mapping in place of a path names a function that makes one.
        """
        self._check_one_robot()
        wanted = self.config["recording"]
        if isinstance(wanted, dict):
            made = make(wanted, "recording", config=self.config)
            if not isinstance(made, Recording):
                raise InputError(
                    f"recording: {wanted['_target_']} must return a Recording, "
                    f"got {type(made).__name__}"
                )
            return self._calibrated(made)
        if wanted is not None:
            recording = load(Path(wanted))
            self._compare_slip(recording)
            return self._calibrated(self._with_classes(recording))
        recording = cached(self.recording_key, lambda: self.simulate(on_progress))
        # a file does not choose what code runs, but the configuration does
        return dataclasses.replace(recording, sensors=self.sensors())

    def _check_one_robot(self) -> None:
        require(
            self.team is None,
            "team: a recording is of one robot; `estima record` and `estima run` take teams",
        )

    def _calibrated(self, recording: Recording) -> Recording:
        """Return the recording as the calibration has it."""
        path = self.config["calibration"]
        return recording if path is None else read_calibration(Path(path)).applied(recording)

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
                print(
                    f"the recording was made with robot.{key}={made_with[key]:g}; "
                    f"{believed[key]:g} is believed unless robot.{key} or estimator.{key} is set",
                    file=sys.stderr,
                )

    def _simulated(self) -> Config:
        """Settings of the recording that would be simulated."""
        return {key: self.config[key] for key in SIMULATED_KEYS}

    def _recording_settings(self) -> Config:
        """What decides the recording."""
        made = {} if isinstance(self.config["recording"], str) else self._simulated()
        if (team := self.config.get("team")) is not None:
            made["team"] = {key: team.get(key) for key in _TEAM_KEYS}
        return {**made, **self._recording_sources()}

    def _recording_sources(self) -> Config:
        """Files and code that decide the recording, beside the simulation's settings."""
        wanted = self.config["recording"]
        if isinstance(wanted, dict):  # its function may read all of the settings
            return {"recording": wanted, "files": files_digest(wanted)}
        if wanted is not None:
            return {"recording": _digest(Path(wanted))}
        sources: Config = {}
        world_file = self.config["world"].get("path")
        if world_file is not None and Path(world_file).is_file():  # an edited file: another world
            sources["world_file"] = _digest(Path(world_file))
            if (image := grid_file.image_of(Path(world_file))) is not None:
                sources["world_image"] = _digest(image)
        if way := files_digest(self.config["route"].get("path")):
            sources["way"] = list(way.values())
        if files := files_of_options(self.config["route"].get("feedback")):
            sources["feedback_files"] = files
        elsewhere = {target: source_digest(target) for target in sorted(targets(self._simulated()))}
        if any(elsewhere.values()):  # a sensor, route or world of one's own, edited: another one
            sources["sources"] = elsewhere
        if any(target.startswith("estimators.") for target in elsewhere):  # one on board
            sources["code"] = code_version()
        return sources

    def prior(self, recording: Recording, number: int = 0) -> Prior:
        """Return what the estimator knows at the start of the robot of this number.

        Raises
        ------
        InputError
            If a start pose is wanted, and the truth does not cover the first Frame.
        """
        self._check_prior()
        settings = self.config["prior"]
        geometry = dataclasses.asdict(recording.robot)
        geometry |= {key: settings[key] for key in geometry if settings[key] is not None}
        robot = build(RobotGeometry, geometry, "prior")
        known_map = self._map(recording)
        if settings["start"] == "global":
            return Prior(robot, recording.sensors, map=known_map)
        sigma = np.array([settings["sigma_position_m"]] * 2 + [settings["sigma_heading_rad"]])
        start = np.zeros(3)
        if recording.truth is not None:
            start = _true_start(recording)
        offset = sigma * stream(self.config["seed"], "prior", number).standard_normal(3)
        return Prior(robot, recording.sensors, start + offset, np.diag(np.square(sigma)), known_map)

    def _map(self, recording: Recording) -> Any:
        """Map of the prior: none, the recording's world, a grid, or what a function makes."""
        wanted = self.config["prior"]["map"]
        if isinstance(wanted, dict):
            return make(wanted, "prior.map", config=self.config, recording=recording)
        if wanted == "none":
            return None
        if _is_grid_file(wanted):
            return grid_file.read_grid(wanted)
        if recording.world is None:
            raise InputError("prior.map=world, but the recording has no map; set prior.map=none")
        return recording.world


def _believe(cfg: DictConfig) -> None:
    """Put the slip of a calibration in the place of a simulated robot's."""
    path = cfg.get("calibration")
    if path is None:
        return
    require(isinstance(path, str) and path, f"calibration must be a path or null, got {path!r}")
    require(
        cfg.get("recording") is not None,
        "calibration is of a real log: set recording too, made by `estima convert LOG -o FILE.npz`",
    )
    slip = read_calibration(Path(path)).slip
    for key in ("kr", "kl"):
        OmegaConf.update(cfg, f"robot.{key}", getattr(slip, key))
    if cfg.estimator.get("forward_slip_m") == 0.0:
        OmegaConf.update(cfg, "estimator.forward_slip_m", slip.forward_slip_m)


def _true_start(recording: Recording) -> Array:
    """True pose (3,) at the first Frame."""
    begin_s = float(recording.frame_stamps[0])
    start: Array = recording.truth_at(recording.frame_stamps[:1])[0]
    spans = recording.known_truth.stamps[[0, -1]]
    require(
        bool(np.isfinite(start).all()),
        f"the first Frame is at {begin_s:.2f} s, and the truth spans {spans[0]:.2f} to "
        f"{spans[1]:.2f} s: no start pose is known; cut the recording to the time of its truth, "
        "or set prior.start=global",
    )
    return start


def rows_folder(name: Any) -> Path:
    """Folder of rows of a name, which must be one word."""
    if not (isinstance(name, str) and re.fullmatch(r"[\w.-]*\w", name)):
        raise InputError(
            f"name must be one word for a folder of results, such as slip_2, got {name!r}"
        )
    return paths.results() / "runs" / name


def _check_shape(config: Config) -> None:
    """Check that every key is there, holds keys or a path where it must, and nowhere NaN."""
    for key in _KEYS:
        parent, _, leaf = key.rpartition(".")
        if leaf not in (config[parent] if parent else config):
            remedy = f"choose one of `estima options {key}`" if key in GROUPS else "set it"
            raise InputError(f"{key} is missing; {remedy}")
        if key in _MAPPINGS and not isinstance(config[key], dict):
            raise InputError(f"{key} must hold keys, got {config[key]!r}")
    for place in ("simulation", "prior", "scoring"):
        for name in config[place]:
            _check_known(f"{place}.{name}")
    wanted = config["recording"]
    if not (wanted is None or isinstance(wanted, dict) or (isinstance(wanted, str) and wanted)):
        got = "nothing" if wanted == "" else repr(wanted)
        raise InputError(f"recording must be a path, null, or a mapping with _target_, got {got}")
    for place, value in _leaves(config):
        require(not _holds_nan(value), f"{'.'.join(map(str, place))} holds NaN; give a number")


def _holds_nan(value: Any) -> bool:
    """Whether a value is NaN, or a list or mapping that has one."""
    if isinstance(value, dict):
        return any(map(_holds_nan, value.values()))
    if isinstance(value, (list, tuple)):
        return any(map(_holds_nan, value))
    return isinstance(value, float) and math.isnan(value)


def _presets_with(names: Sequence[str]) -> list[str]:
    """Options of conf/sensors that have one of these sensors."""
    found = {path.stem: OmegaConf.load(path) for path in (paths.CONF / "sensors").glob("*.yaml")}
    return sorted(preset for preset, sensors in found.items() if any(n in sensors for n in names))


def searched(config_dir: str | Path | None) -> list[str]:
    """Override that makes Hydra look for options in another folder too; none for None.

    Raises
    ------
    InputError
        If there is no such folder, or one of its options is no YAML that can be read.
    """
    if config_dir is None:
        return []
    folder = Path(config_dir).resolve()
    if not folder.is_dir():
        raise InputError(f"--config-dir must name a folder, got {config_dir}")
    require("${" not in str(folder), f"{folder}: Hydra takes ${{ for a value; rename the folder")
    for group in (*GROUPS, "study"):
        for path in sorted((folder / group).glob("*.yaml")):
            option = read_yaml(path)  # within bounds, which Hydra does not know
            keys = option is None or (
                isinstance(option, dict) and all(isinstance(key, str) for key in option)
            )
            require(keys, f"{path}: an option holds keys and their values")
            _check_hydra_of(path, option or {})
    return [f"hydra.searchpath=[{paths.quoted(f'file://{folder}')}]"]


def with_study_file(overrides: Sequence[str]) -> list[str]:
    """Overrides in which `study=FILE.yaml` is a name, and the folder in which Hydra looks for it.

    Hydra knows an option by its name in a folder of its group, so a study that lies elsewhere is
    copied to one.

    Raises
    ------
    InputError
        If there is no such file.
    """
    found: list[str] = []
    for override in overrides:
        key, _, value = override.partition("=")
        path = Path(value)
        if key != "study" or path.suffix != ".yaml":
            found.append(override)
            continue
        require(path.is_file(), f"{override}: there is no such file")
        place = path.resolve()
        if place.parent.name != "study":
            place = paths.results() / "cache" / "studies" / _digest(path)[:16] / "study" / path.name
            write_text(place, path.read_text())
        found += [*searched(place.parents[1]), f"study={path.stem}"]
    return found


def _check_hydra_of(path: Path, option: Mapping[str, Any]) -> None:
    """Check that an option's file has none of Hydra's settings that nothing here reads."""
    defaults = option.get("defaults")
    entries = [e for e in defaults if isinstance(e, dict)] if isinstance(defaults, list) else []
    set_here = [group for entry in entries for group in entry if "/hydra/" in str(group)]
    set_here += [
        ".".join(map(str, leaf))
        for leaf, value in _leaves({"hydra": option.get("hydra")})
        if value not in (None, {}) and leaf[:3] != ("hydra", "sweeper", "params")
    ]
    if set_here:
        raise InputError(
            f"{path}: {set_here[0]}: of Hydra's settings a file's hydra.sweeper.params alone has "
            "an effect; give hydra/launcher and hydra.launcher on the command line"
        )


def _check_known(key: str) -> None:
    """Check that a key is one of the configuration's own."""
    if key not in _KEYS:
        place = key.rpartition(".")[0]
        known = [other for other in _KEYS if other.rpartition(".")[0] == place]
        raise InputError(f"unknown key {key}; known: {', '.join(known)}")


def check_added(hydra: Any) -> None:
    """Check that no override adds a key that nothing reads.

    A study's YAML may have keys of its own; the command line sets those without a +.

    Parameters
    ----------
    hydra
        Hydra's own settings of a composed configuration.

    Raises
    ------
    InputError
        Naming the key, and the known ones.
    """
    groups = {choice.partition("@")[0] for choice in hydra.runtime.choices}
    overrides = OverridesParser.create().parse_overrides(list(hydra.overrides.task))
    calibrated = any(o.key_or_group == "calibration" and o.value() is not None for o in overrides)
    for override in overrides:
        if override.key_or_group in ("robot.kr", "robot.kl") and calibrated:
            key = override.key_or_group.removeprefix("robot.")
            raise InputError(
                f"{override.input_line}: the calibration has its own {key}; set estimator.{key} to "
                "believe another, or leave calibration out"
            )
        added = override.is_add() or override.is_force_add()
        if added and override.key_or_group not in groups:
            _check_known(override.key_or_group.partition(".")[0])


def check_hydra(overrides: Sequence[str]) -> None:
    """Check that no override is one of Hydra's own settings that nothing here reads.

    Raises
    ------
    InputError
        Naming what to do instead.
    """
    for override in overrides:
        key = override.lstrip("+~").partition("=")[0]
        if re.match(r"hydra\b", key) is None or key.startswith(_READ_OF_HYDRA):
            continue
        remedies = {
            "hydra/sweeper": "-m runs every combination of the values; an optimizer may call "
            "estima.sweep from Python",
            "hydra.sweeper": "give the values themselves, such as seed=1,2",
            "hydra.verbose": "there is no log; a failed run's row says how",
        }
        usual = "rows go to results/runs/NAME: set name, or --results for another folder"
        remedy = next((remedies[start] for start in remedies if key.startswith(start)), usual)
        raise InputError(f"{override}: {key} has no effect here; {remedy}")


def check_overrides(overrides: Sequence[str]) -> None:
    """Check what Hydra itself does not: that each override has a key, and groups have names.

    Raises
    ------
    InputError
        Naming the override.
    """
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        key, value = override.key_or_group, override.value()
        if not key:
            raise InputError(f"{override.input_line}: no key before the =")
        named = override.is_sweep_override() or isinstance(value, (str, list))
        if key == "hydra.searchpath" and isinstance(value, list):
            for entry in value:
                scheme, _, place = str(getattr(entry, "text", entry)).rpartition("://")
                there = scheme not in ("", "file") or Path(place).is_dir()
                require(there, f"{override.input_line}: there is no folder {place}")
        if key in (*GROUPS, "study") and not (named or override.is_delete()):
            raise InputError(
                f"{override.input_line}: {key} must name one of `estima options {key}`"
            )


def composed(overrides: Sequence[str]) -> tuple[DictConfig, Mapping[str, str]]:
    """Have Hydra, once initialized, compose a configuration; also give the options it chose."""
    check_overrides(overrides)
    cfg = compose("config", overrides=list(overrides), return_hydra_config=True)
    check_added(cfg.hydra)
    choices = cfg.hydra.runtime.choices
    OmegaConf.set_struct(cfg, False)
    del cfg["hydra"]
    return cfg, choices


def _is_grid_file(known_map: Any) -> bool:
    return isinstance(known_map, str) and Path(known_map).suffix in grid_file.SUFFIXES


def files_digest(tree: Any) -> dict[str, str]:
    """Digest of every file that a mapping names, and of the files in each folder it names.

    A grid's image counts with its YAML file.
    """
    if isinstance(tree, dict):
        return {k: v for value in tree.values() for k, v in files_digest(value).items()}
    if not isinstance(tree, str) or not Path(tree).name:
        return {}
    path = Path(tree)
    try:
        files = [path] if path.is_file() else sorted(path.glob("*")) if path.is_dir() else []
        files += [image for file in files if (image := grid_file.image_of(file)) is not None]
    except OSError:  # too long for a path, say
        return {}
    return {str(file): _digest(file) for file in files if file.is_file()}


def files_of_options(options: Any) -> dict[str, str]:
    """Digest of every file that an estimator's options name, a list's items included.

    A word without a suffix or a slash is no file, but the name of a sensor or a method.
    """
    found: dict[str, str] = {}
    for _, value in _leaves({"": options}):
        for text in value if isinstance(value, list) else [value]:
            if isinstance(text, str) and ("/" in text or Path(text).suffix):
                found |= files_digest(text)
    return found


def _digest(path: Path) -> str:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot read it ({error.strerror})") from error


def decides_recording(leaf: tuple[str, ...], *, from_file: bool) -> bool:
    """Whether a leaf of the configuration decides which recording is read."""
    of_team = leaf[0] == "team" and leaf[1] in _TEAM_KEYS
    return of_team or (leaf[0] in SIMULATED_KEYS and not from_file)


def leaf_digest(leaf: tuple[str, ...], value: Any) -> int:
    """Return 64 bits of a digest of a plain value and its place in the configuration."""
    return next(leaf_digests(leaf, [value]))


def leaf_digests(leaf: tuple[str, ...], values: Iterable[Any]) -> Iterator[int]:
    """Give the digest of each of many values of one leaf."""
    place = hashlib.blake2b(json.dumps(leaf).encode(), digest_size=8)
    for value in values:
        nested = isinstance(value, (list, dict))
        digest = place.copy()
        digest.update((json.dumps(value, sort_keys=True) if nested else json.dumps(value)).encode())
        yield int.from_bytes(digest.digest())


def _leaves(tree: Mapping[str, Any], above: tuple[str, ...] = ()) -> Iterator[tuple[Any, Any]]:
    """Every place of a configuration that holds no keys, and its value."""
    for name, value in tree.items():
        if isinstance(value, dict) and value:
            yield from _leaves(value, (*above, name))
        else:
            yield (*above, name), value


def _flat(tree: Mapping[str, Any], prefix: str = "") -> Row:
    """Flatten nested mappings to dotted keys; lists become their text."""
    flat: Row = {}
    for key, value in tree.items():
        name = f"{prefix}{key}"
        if isinstance(value, dict):
            flat.update(_flat(value, f"{name}."))
        elif isinstance(value, int) and not -(2**63) <= value < 2**63:
            flat[name] = str(value)  # wider than a column of a table
        elif value is None or isinstance(value, (bool, int, float, str)):
            flat[name] = value
        else:
            flat[name] = json.dumps(value)
    return flat
