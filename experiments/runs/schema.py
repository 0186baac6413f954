"""What a configuration holds: its keys, the defaults of what it names, and its files' options."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from enum import Enum
from typing import Annotated, Any, Literal, NamedTuple

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf
from pydantic import Field

from estimators.team import Communication
from experiments.runs.dependencies.recorder import is_recording
from experiments.runs.paths import CONF
from sim import sensors
from sim.errors import InputError, describe_unknown, require
from sim.options import Count, NonNegative, Positive, defaults, described, find, options
from sim.people.walk import People
from sim.robot.drive import DifferentialDrive

Config = dict[str, Any]
Leaf = tuple[str, ...]  # a place in the configuration: ("robot", "kr")
GROUPS = ("world", "robot", "sensors", "route", "estimator")
SIMULATED_KEYS = (
    "world", "robot", "sensors", "route", "simulation", "people", "seed", "world_seed"
)  # fmt: skip
_OWN = ("robot", "sensors", "route")  # groups in which a robot of a team may differ
_INJECTED = ("rng", "config", "recording")  # arguments that the program passes
_UNSET = object()


@options("simulation")
class SimulationOptions:
    """The key `simulation`."""

    physics: Literal["bullet", "kinematic"]
    """The engine, or the same slip law with ideal rolling."""
    rays: Literal["bullet", "exact"]
    """How rays are cast; the geometry is the same."""

    def __post_init__(self) -> None:
        require(
            self.physics == "bullet" or self.rays == "exact",
            "simulation.rays=bullet needs the engine; set simulation.rays=exact",
        )


@options("prior")
class PriorOptions:
    """The key `prior`: what the estimator knows at the start."""

    start: Literal["tracking", "global"]
    """The first true pose, or none."""
    sigma_position_m: NonNegative
    """Of the first belief, m; its mean is drawn with it."""
    sigma_heading_rad: NonNegative
    wheel_radius_m: Positive | None
    """What the estimator believes of the robot, m; null: what the recording says."""
    track_m: Positive | None
    map: Any
    """none, world, a grid's file, or a mapping with `_target_`."""


@options("scoring")
class ScoringOptions:
    """The key `scoring`: options of `experiments.evaluation.metrics.score`."""

    longest_gap_s: NonNegative
    """Of the truth, over which it is interpolated, s; Frames in longer ones do not count."""
    after_s: NonNegative
    """Frames of the first seconds do not count, s."""


@options("")
class RunOptions:
    """Keys of a run that stand alone."""

    repeats: Annotated[int, Field(ge=1, le=100_000)]
    """Runs of the estimator over the same recording, a row each."""
    keep: list[str]
    """Names of belief extras to record."""
    picture: bool
    """Whether a single run is drawn."""
    isolated: bool
    """Whether the estimator runs in a child process, which never holds the truth."""


@options("team")
class TeamSettings:
    """The key `team`."""

    size: Count
    """How many of the robots drive."""
    starts: Literal["known", "unknown"]
    """`known`: each robot has a prior. `unknown`: robot 0 alone has one."""
    communication: Communication
    """See `estimators.team.Communication`."""
    robots: list[dict[str, Any]]
    """For each robot, keys of `robot`, `sensors` and `route` in which it differs; {} for none."""

    def __post_init__(self) -> None:
        require(
            self.size <= len(self.robots),
            f"team.size must be from 1 to the {len(self.robots)} of team.robots, got {self.size}",
        )
        require(
            self.starts == "known" or self.communication.kind != "never",
            "team.starts=unknown: a robot that hears nothing of the others is never placed; set "
            "another team.communication",
        )


OPTIONS: dict[str, type] = {
    "simulation": SimulationOptions,
    "people": People,
    "prior": PriorOptions,
    "scoring": ScoringOptions,
}
_UNNAMED = {"robot": DifferentialDrive, "people": People}  # what takes keys without a _target_
_MAPPINGS = (*GROUPS, *OPTIONS)
KEYS = (*_MAPPINGS, "seed", "world_seed", "recording", "calibration", "name")
RUN_KEYS = ("repeats", "keep", "picture", "isolated")  # of `RunOptions`
KEYS += RUN_KEYS


def describe_unknown_key(key: str, config: Mapping[str, Any]) -> str:
    """Say that a key is unknown, and which ones are known next to it."""
    *parents, last = key.split(".")
    for depth, part in enumerate(parents):
        if not isinstance(config.get(part), Mapping):
            parents, last = parents[:depth], ".".join([*parents[depth:], last])
            break
        config = config[part]
    return describe_unknown(
        last, (name for name in config if name not in ("hydra", "_target_")), ".".join(parents)
    )


def leaves(tree: Mapping[str, Any], above: Leaf = ()) -> Iterator[tuple[Leaf, Any]]:
    """Every place of a configuration that holds no keys, and its value."""
    for name, value in tree.items():
        if isinstance(value, dict) and value:
            yield from leaves(value, (*above, name))
        else:
            yield (*above, name), value


def with_leaf(tree: Mapping[str, Any], leaf: Leaf, value: Any) -> Config:
    """The configuration with another value of a leaf, whose mappings are made if need be."""
    first, *rest = leaf
    if not rest:
        return {**tree, first: value}
    inside = tree.get(first)
    return {**tree, first: with_leaf(inside if isinstance(inside, dict) else {}, (*rest,), value)}


# The defaults of what is named


def fill(cfg: DictConfig) -> None:
    """Give a composed configuration the defaults of what it names, where it does not state a key.

    These are those of the robot, the people, and each `_target_` of a world, sensor, route and
    estimator.
    """
    for place in _places(cfg, (*GROUPS, "people")):
        settings = value_at(cfg, place)
        hidden = place == "estimator" and cfg.get("isolated") is True
        if isinstance(settings, DictConfig) and not (hidden and not is_ours(settings)):
            with suppress(InputError):  # `check` says it
                filled = _filled(_target(settings, place), OmegaConf.to_container(settings))  # type: ignore[arg-type]
                OmegaConf.update(cfg, place, filled, merge=False)


def is_ours(settings: Mapping[str, Any]) -> bool:
    """Whether what the settings of an estimator name belongs to this package."""
    return str(settings.get("_target_")).startswith("estimators.")


def value_at(cfg: DictConfig, key: str) -> Any:
    """What stands at a key; None if it cannot be resolved."""
    return OmegaConf.select(cfg, key, throw_on_resolution_failure=False)


def _places(cfg: DictConfig, groups: Iterable[str]) -> Iterator[str]:
    """Places of some groups that hold a `_target_`: each sensor has one of its own."""
    for group in groups:
        if group != "sensors":
            yield group
        elif isinstance(sensors := value_at(cfg, group), DictConfig):
            yield from (f"sensors.{name!s}" for name in sensors)


def _target(settings: DictConfig, place: str) -> Callable[..., Any]:
    """What takes the settings of a place."""
    if place in _UNNAMED and "_target_" not in settings:
        return _UNNAMED[place]
    return find(value_at(settings, "_target_"), place)


def _filled(target: Callable[..., Any], given: Mapping[str, Any]) -> Config:
    """Keys and their values, in the order of the target's own, with its defaults."""
    filled = {"_target_": given["_target_"]} if "_target_" in given else {}
    for name, default in _defaults(target).items():
        value = given.get(name, _plain(default))
        if dataclasses.is_dataclass(default) and isinstance(value, dict):
            value = _filled(type(default), value)
        if value is not _UNSET:
            filled[name] = value
    return {**filled, **{name: value for name, value in given.items() if name not in filled}}


def _defaults(target: Callable[..., Any]) -> dict[str, Any]:
    """Defaults of what a configuration names; none of what has no signature."""
    try:
        return {name: each for name, each in defaults(target).items() if name not in _INJECTED}
    except ValueError:
        return {}


def _plain(value: Any) -> Any:
    """A default as a configuration holds it; `_UNSET` for one that it cannot hold."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = dataclasses.asdict(value)
    if isinstance(value, Enum):
        value = value.value
    if isinstance(value, dict):
        plain = {str(name): _plain(part) for name, part in value.items()}
        return _UNSET if _UNSET in plain.values() else plain
    if isinstance(value, (list, tuple)):
        parts = [_plain(part) for part in value]
        return _UNSET if _UNSET in parts else parts
    scalar = value is None or isinstance(value, (str, bool, int, float))
    return value if scalar and not _holds_nan(value) else _UNSET


def sensor_class(name: str) -> type | None:
    """Class of a sensor by its name, in any case; None if there is none."""
    classes = {
        each: kind
        for each, kind in vars(sensors).items()
        if hasattr(kind, "start") and each != "Sensor"
    }
    return next((kind for each, kind in classes.items() if each.lower() == name.lower()), None)


def describe_option(group: str, name: str, searched: Sequence[str] = ()) -> str:
    """Say what an option's keys are: default, what each accepts, and what it means.

    Parameters
    ----------
    group, name
        Such as `estimator` and `ekf_slam`. Of one sensor: `sensors` and `lms291.laser`, or the name
        of its class.
    searched
        Overrides by which Hydra finds options in other folders.

    Raises
    ------
    InputError
        If the group or sensor is unknown, or what the option names cannot be found.
    """
    if group in OPTIONS:
        with initialize_config_dir(str(CONF), version_base="1.3"):
            keys: Config = OmegaConf.to_container(compose("config")[group])  # type: ignore[assignment]
        return "\n".join([group, *_said(OPTIONS[group], keys)])
    require(group in GROUPS, f"no group {group}; there are: {', '.join(GROUPS)}")
    kind = sensor_class(name) if group == "sensors" else None
    if kind is not None:
        return "\n".join([f"{kind.__module__}.{kind.__qualname__}", *_said(kind, {})])
    option, _, only = name.partition(".")
    with initialize_config_dir(str(CONF), version_base="1.3"):
        cfg = compose("config", overrides=[*searched, f"{group}={option}"])
    places = []
    if only:
        require(
            group == "sensors" and only in cfg.sensors,
            f"no sensor {only} in {option}; there are: {', '.join(cfg.sensors)}",
        )
        places = [f"{group}.{only}"]
    parts = []
    for place in places or _places(cfg, [group]):
        if (settings := value_at(cfg, place)) is not None:
            stated: Config = OmegaConf.to_container(settings)  # type: ignore[assignment]
            title = f"{place}: {stated['_target_']}" if "_target_" in stated else place
            parts.append("\n".join([title, *_said(_target(settings, place), stated)]))
    return "\n\n".join(parts)


def _said(target: Callable[..., Any], stated: Mapping[str, Any]) -> Iterator[str]:
    """A line for each option, and one of its meaning."""
    known = _defaults(target)
    for option in (each for each in (described(target) if known else ()) if each.name in known):
        value = stated.get(option.name, option.default)
        words = {dataclasses.MISSING: "needed", None: "null", True: "true", False: "false"}
        shown = next((said for known, said in words.items() if value is known), value)
        yield f"  {option.name}: {shown}" + (f"  ({option.accepts})" if option.accepts else "")
        if option.meaning:
            yield f"      {option.meaning}"


# What a configuration must hold


def check_shape(config: Config) -> None:
    """Check that every key is there, holds keys or a path where it must, and none holds NaN.

    Raises
    ------
    InputError
        Naming the key, and the remedy.
    """
    for key in KEYS:
        remedy = f"choose one of `estima options {key}`" if key in GROUPS else "set it"
        require(key in config, f"{key} is missing; {remedy}")
        holds_keys = isinstance(config[key], dict) or key not in _MAPPINGS
        require(holds_keys, f"{key} must hold keys, got {config[key]!r}")
    wanted = config["recording"]
    require(
        wanted is None or (isinstance(wanted, (dict, str)) and wanted != ""),
        "recording must be a path, null, or a mapping with _target_, got "
        f"{'nothing' if wanted == '' else repr(wanted)}",
    )
    for leaf_, value in leaves(config):
        require(not _holds_nan(value), f"{'.'.join(map(str, leaf_))} holds NaN; give a number")


def _holds_nan(value: Any) -> bool:
    """Whether a value is NaN, or a list or mapping that has one."""
    if isinstance(value, dict):
        return any(map(_holds_nan, value.values()))
    if isinstance(value, (list, tuple)):
        return any(map(_holds_nan, value))
    return isinstance(value, float) and math.isnan(value)


def robot_config(config: Config, settings: TeamSettings, number: int) -> Config:
    """Configuration of one of the robots, which has no key `team`.

    Raises
    ------
    InputError
        If the robot has a key that its group has not.
    """
    own = {key: value for key, value in config.items() if key != "team"}
    for group, values in settings.robots[number].items():
        where = f"team.robots[{number}].{group}"
        require(group in _OWN, describe_unknown(group, _OWN, f"team.robots[{number}]"))
        require(isinstance(values, Mapping), f"{where} must hold keys, got {values!r}")
        for key in [key for key in values if key not in own[group]]:
            raise InputError(describe_unknown(key, own[group], where))
        own[group] = {**own[group], **values}
    return own


# What Hydra composes


class FromFiles(NamedTuple):
    """A configuration as Hydra composes it.

    Attributes
    ----------
    cfg
        The configuration, without Hydra's own.
    choices
        Name of the chosen option of each group.
    params
        `hydra.sweeper.params` of a study's file.
    """

    cfg: DictConfig
    choices: Mapping[str, str]
    params: Mapping[str, str]


def compose_files(overrides: Sequence[str], searched: Sequence[str] = ()) -> FromFiles:
    """Compose a configuration, which takes Hydra 50 ms; it is kept while conf/ is the same.

    While dependencies are recorded, the files are read each time, so that they are seen.

    Parameters
    ----------
    searched
        Overrides that make Hydra look for options elsewhere too; then nothing is kept.
    """
    if searched or is_recording():
        return _composed((*searched, *overrides))
    files = ((str(path), path.stat()) for path in sorted(CONF.rglob("*.yaml")))
    state = tuple((name, s.st_mtime_ns, s.st_size, s.st_ino) for name, s in files)
    kept = _kept(tuple(overrides), state)
    return kept._replace(cfg=kept.cfg.copy())


def _composed(overrides: Sequence[str]) -> FromFiles:
    cfg = compose("config", overrides=list(overrides), return_hydra_config=True)
    choices, params = dict(cfg.hydra.runtime.choices), cfg.hydra.sweeper.get("params") or {}
    OmegaConf.set_struct(cfg, False)
    del cfg["hydra"]
    return FromFiles(cfg, choices, dict(params))


@functools.lru_cache(maxsize=256)
def _kept(overrides: tuple[str, ...], _state: tuple[Any, ...]) -> FromFiles:
    return _composed(overrides)
