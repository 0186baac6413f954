"""An experiment: what a configuration names, what its runs are called, and whether it fits."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import operator
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from estimators.base import Estimator
from estimators.programs.host import Isolated
from estimators.programs.places import needs_of
from experiments.runs import paths
from experiments.runs.calibration import BELIEVED
from experiments.runs.compose import open_composer
from experiments.runs.key import origin_columns, run_key
from experiments.runs.objects import OF_TEAMS, Objects, is_grid_file
from experiments.runs.row import Row
from experiments.runs.schema import (
    OPTIONS,
    RUN_KEYS,
    Config,
    Leaf,
    RunOptions,
    check_shape,
    is_ours,
    with_leaf,
)
from experiments.runs.seeds import stream
from experiments.runs.targets import check_target
from sim.errors import InputError, require
from sim.options import build, find
from sim.recording import Recording
from sim.worlds import grid_file
from sim.worlds.grid import OccupancyGrid
from sim.worlds.world import World


class Experiment(Objects):
    """A world, a robot, its sensors and route, or a recording of them; and an estimator."""

    @classmethod
    def compose(
        cls, overrides: Sequence[str] = (), data: Sequence[str] = (), source: object = ""
    ) -> Experiment:
        """Compose an experiment from Hydra's overrides, such as `world=office seed=3`.

        Parameters
        ----------
        data, source
            Further overrides that the user did not write, and the file that they come from.
        """
        with open_composer(overrides, data, source) as composer:
            return cls(*composer.compose(composer.words).resolve())

    def with_values(self, **values: Any) -> Experiment:
        """Return the experiment with other values of top-level keys, such as `seed=3`."""
        return dataclasses.replace(self, config={**self.config, **values})

    def with_leaves(self, changed: Iterable[tuple[Leaf, Any]]) -> Experiment:
        """Return the experiment with other values of places, such as `("robot", "kr")`."""
        config = self.config
        for leaf, value in changed:
            config = with_leaf(config, leaf, value)
        return dataclasses.replace(self, config=config)

    def with_estimator_object(self, estimator: Estimator) -> Experiment:
        """Return the experiment with an estimator that is not an option of the configuration."""
        kind = type(estimator)
        return dataclasses.replace(
            self.with_values(estimator={"class": f"{kind.__module__}.{kind.__qualname__}"}),
            choices={**self.choices, "estimator": kind.__name__},
            own_estimator=estimator,
        )

    def with_estimator(self, **settings: Any) -> Experiment:
        """Return the experiment with other values of keys of its estimator."""
        return self.with_values(estimator={**self.config["estimator"], **settings})

    def option(self, name: str, default: Any = None) -> Any:
        """An option of the estimator; `default` if it has none of this name."""
        return self.options_of("estimator").get(name, default)

    def options_of(self, place: str) -> Config:
        """What a place such as `estimator` or `prior.map` holds; nothing if it is a plain value."""
        value = functools.reduce(operator.getitem, place.split("."), self.config)
        return {**value} if isinstance(value, dict) else {}

    def with_recording(self, recording: Recording) -> Experiment:
        """Return the experiment over a recording in memory, identified by its checksum."""
        require(
            self.config["calibration"] is None,
            "calibration is for recording=FILE; of a recording in memory take "
            "read_calibration(FILE).apply_to(recording)",
        )
        self._compare_slip(recording)
        return self.with_values(recording={"checksum": recording.checksum})

    # What a run is called, and where its rows go

    @property
    def name(self) -> str:
        """Folder of the rows in results/runs."""
        return str(self.config["name"])

    @property
    def from_file(self) -> bool:
        """Whether its recording is read or made, rather than simulated."""
        return self.config["recording"] is not None

    @property
    def has_own_map(self) -> bool:
        """Whether the prior's map is a file, which fits one world alone."""
        return is_grid_file(self.config["prior"]["map"])

    @property
    def is_read(self) -> bool:
        """Whether its recording is read from a file."""
        return isinstance(self.config["recording"], str)

    @property
    def command(self) -> Any:
        """The command of an estimator that is a program; None of one that is not."""
        return self.option("command")

    def label(self, key: str) -> Any:
        """Value of a key that a study adds to the configuration's own."""
        return self.config[key]

    @property
    def believed_slip(self) -> tuple[float, float] | None:
        """The kr and kl that the estimator believes, m; None if it has no such options."""
        kr, kl = self.option("kr"), self.option("kl")
        return None if kr is None or kl is None else (kr, kl)

    @property
    def not_believed(self) -> list[str]:
        """Numbers of the calibration that the estimator has no use for."""
        unused = [key for key in BELIEVED if key not in self.options_of("estimator")]
        return unused if self.config["calibration"] is not None else []

    @property
    def repeats(self) -> int:
        """Runs of the estimator over the recording."""
        return int(self.config["repeats"])

    @property
    def rows_folder(self) -> Path:
        """Folder of the rows."""
        return paths.rows_folder(self.config["name"])

    @property
    def key(self) -> str:
        """Digest of what decides the rows; see `experiments.runs.key.run_key`."""
        return run_key(self.config)

    def labels(self, checksum: str) -> Row:
        """Columns that state a row's origin; see `experiments.runs.key.origin_columns`."""
        return origin_columns(self.config, self.choices, checksum)

    # Whether it fits

    def check(self) -> None:
        """Find what is wrong or does not fit together, before any run.

        Raises
        ------
        InputError
            Naming the key, and the remedy.
        """
        config = self.config
        check_shape(config)
        RunOptions(**{key: config[key] for key in RUN_KEYS})
        for place, kind in OPTIONS.items():
            build(kind, config[place], place)
        self.robot()
        self.sensors()
        self.route()
        check_target(config["world"], "world", ("rng",))
        stream(config["seed"], "slip")
        stream(config["world_seed"], "world", key="world_seed")
        require(
            not self.isolated or (self.own_estimator is None and self.team is None),
            "isolated=true runs an estimator of one robot that estimator._target_ names; an object "
            "in memory and those of a team run in this process",
        )
        self._check_team()
        self._check_needs()
        self._check_map()

    def check_estimator(self) -> None:
        """Check that the estimator can be found, and takes its options.

        Raises
        ------
        InputError
            Naming the option, and the remedy.
        """
        self._named_estimator()

    def _named_estimator(self) -> Any:
        """What the configuration names; in place of a stranger's that is isolated, what asks it."""
        if self.isolated and not is_ours(self.config["estimator"]):
            return Isolated
        return self.own_estimator or check_target(self.config["estimator"], "estimator")

    def _needs(self) -> frozenset[str]:
        """Options that name a sensor the estimator cannot do without, and `map`."""
        settings = self.config["estimator"]
        estimator = self._named_estimator()
        if is_ours(settings):
            # its values too; one from elsewhere may take long to make
            estimator = self.with_values(isolated=False).estimator()
        return frozenset(getattr(estimator, "needs", ()))

    def _needs_stated(self) -> frozenset[str]:
        """The same as its class states it, or a program's command: it need not be installed."""
        stated = getattr(find(self.config["estimator"]["_target_"], "estimator"), "needs", ())
        return needs_of(str(self.command)) if isinstance(stated, property) else frozenset(stated)

    def sensors_needed(self) -> list[str]:
        """Names of the sensors there are that the estimator cannot do without."""
        settings, has = self.config["estimator"], self.config["sensors"]
        names = [settings.get(o, o) for need in self._needs_stated() for o in need.split("|")]
        return sorted(name for name in names if has.get(name) is not None)

    @property
    def lacks_program(self) -> bool:
        """Whether the estimator is a program of the user's, and none is named."""
        return bool(self.config["estimator"].get("command", self.estimator_name) is None)

    def missing(self) -> list[str]:
        """What the estimator needs and does not get, in words."""
        needs, settings = self._needs_stated(), self.config["estimator"]
        without = self._without(needs - {"map"}, settings)
        words = [f"a sensor {' or '.join(names)}" for names in without]
        kinds = getattr(find(settings["_target_"], "estimator"), "maps", None) or [World]
        known_map = self.config["prior"]["map"]
        if "map" in needs and World not in kinds and not isinstance(known_map, dict):
            words.append("a topological map (prior.map._target_)")
        elif "map" in needs and known_map == "none" and not settings.get("map_path"):
            words.append("a map (prior.map=world)")
        if self.config["prior"]["start"] == "global" and "map" not in needs:
            words.append("a known start (prior.start=tracking)")  # only a map tells where it is
        if self.team is not None and not self._takes_teams():
            words.append("a single robot")
        return words

    def _check_needs(self) -> None:
        """Check that the estimator gets the sensors and the map that it needs."""
        settings, needs = self.config["estimator"], self._needs()
        if not self.from_file:
            self._check_sensors(f"estimator={self.estimator_name}", needs - {"map"}, settings)
            onboard = self.config["route"].get("feedback")
            if isinstance(onboard, dict):
                steering = getattr(self._steering(), "needs", ())
                self._check_sensors("route.feedback", frozenset(steering) - {"map"}, onboard)
        mapped = self.config["prior"]["map"] != "none" or settings.get("map_path")
        require(
            mapped or "map" not in needs,
            f"estimator={self.estimator_name} needs a map; set prior.map=world, "
            "prior.map=GRID.yaml, or a mapping with _target_",
        )

    def _check_map(self) -> None:
        """Check that the prior's map can be made or read, and that the estimator can use it."""
        known_map = self.config["prior"]["map"]
        if isinstance(known_map, dict):
            check_target(known_map, "prior.map", ("config", "recording"))
        elif not is_grid_file(known_map):
            require(
                known_map in ("none", "world"),
                "prior.map must be none, world, a grid's .yaml file or a mapping with _target_, "
                f"got {'null' if known_map is None else repr(known_map)}",
            )
        else:
            grid_file.read_grid(known_map)
            estimator = self._named_estimator()
            kinds = getattr(estimator, "maps", None) or [OccupancyGrid]
            require(
                OccupancyGrid in kinds or self.option("map_path"),
                f"estimator={self.estimator_name} takes a "
                f"{' or '.join(kind.__name__ for kind in kinds)}, and prior.map={known_map} is an "
                "occupancy grid",
            )

    def _takes_teams(self) -> bool:
        kind = find(self.config["estimator"].get("_target_"), "estimator")
        return not inspect.isclass(kind) or hasattr(kind, "step_team")

    def _check_team(self) -> None:
        """Check each robot of a team, and what only a robot alone can have."""
        team = self.team
        if team is None:
            return
        require(
            self._takes_teams(),
            f"estimator={self.estimator_name} localizes one robot; a team takes {OF_TEAMS}",
        )
        if self.option("robots") is not None and not self.from_file:
            self._check_sensors(
                f"estimator={self.estimator_name}", ["robots"], self.config["estimator"]
            )
        for number, own in enumerate(map(self.of_robot, range(team.size))):
            try:
                own.robot(), own.sensors(), own.route()
            except InputError as error:
                raise InputError(f"team.robots[{number}]: {error}") from error
        require(
            self.config["prior"]["start"] == "tracking",
            "prior.start=global: the start of robot 0 must be known to a team; those of the "
            "others may be unknown (team.starts)",
        )
        require(not self.config["keep"], "keep applies to one robot; leave it out for a team")

    def _check_sensors(self, who: str, needs: Iterable[str], settings: Config) -> None:
        """Check that the robot has the sensors that an estimator needs."""
        for names in self._without(needs, settings):
            presets = [
                path.stem
                for path in sorted((paths.CONF / "sensors").glob("*.yaml"))
                if OmegaConf.load(path).keys() & set(names)
            ]
            remedy = f"try sensors={', '.join(presets)}" if presets else f"add sensors.{names[0]}"
            raise InputError(
                f"{who} needs a sensor {' or '.join(names)}, and "
                f"sensors={self.choices.get('sensors')} has none; {remedy}"
            )

    def _without(self, needs: Iterable[str], settings: Config) -> list[list[str]]:
        """The sensors that are needed and not there: for each, the names that would do."""
        has = {name for name, sensor in self.config["sensors"].items() if sensor is not None}
        # an option of the estimator says how the sensor is called
        named = ([settings.get(option, option) for option in need.split("|")] for need in needs)
        return [names for names in named if has.isdisjoint(names)]
