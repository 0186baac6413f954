"""What a configuration holds: its keys, and the defaults of what it names."""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from enum import Enum
from typing import Any, Literal

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from estimators.team import Communication
from experiments.runs.paths import CONF
from sim import sensors
from sim.errors import InputError, require
from sim.options import Count, NonNegative, Option, Positive, described, find, options
from sim.robot.drive import DifferentialDrive

Config = dict[str, Any]
Leaf = tuple[str, ...]  # a place in the configuration: ("robot", "kr")
GROUPS = ("world", "robot", "sensors", "route", "estimator")
SIMULATED_KEYS = ("world", "robot", "sensors", "route", "simulation", "seed", "world_seed")
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

    repeats: Count
    """Runs of the estimator over the same recording, a row each."""
    keep: list[str]
    """Names of belief extras to record."""
    picture: bool
    """Whether a single run is drawn."""


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
    "prior": PriorOptions,
    "scoring": ScoringOptions,
}
_MAPPINGS = (*GROUPS, *OPTIONS)
_KEYS = (
    *_MAPPINGS,
    *("seed", "world_seed", "recording", "calibration", "name", "repeats", "keep", "picture"),
    *(f"{place}.{option.name}" for place, kind in OPTIONS.items() for option in described(kind)),
)


def unknown(key: str, known: Iterable[str]) -> str:
    """Say that a key is unknown, and which ones are known, the nearest spelled first."""
    names = list(dict.fromkeys(known))
    near = difflib.get_close_matches(key, names, n=3)
    return f"unknown key {key}; known: {', '.join(dict.fromkeys([*near, *names])) or 'none'}"


def unknown_key(key: str, config: Mapping[str, Any]) -> str:
    """Say that a key is unknown, and which ones are known next to it."""
    place = ""
    for part in key.split(".")[:-1]:
        if not isinstance(config.get(part), Mapping):
            break
        place, config = f"{place}{part}.", config[part]
    return unknown(key, (f"{place}{name}" for name in config if name != "hydra"))


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

    These are those of the robot, and of each `_target_` of a world, sensor, route and estimator.
    """
    places = [group for group in GROUPS if group != "sensors"]
    if isinstance(_raw(cfg, "sensors"), DictConfig):
        places += [f"sensors.{name}" for name in cfg.sensors]
    for place in places:
        settings = _raw(cfg, place)
        target = _target(settings, place)
        if target is not None:
            given = OmegaConf.to_container(settings, resolve=False)
            OmegaConf.update(cfg, place, _filled(target, given), merge=False)  # type: ignore[arg-type]


def _raw(cfg: DictConfig, place: str) -> Any:
    """What stands at a place; None if it cannot be resolved."""
    try:
        return OmegaConf.select(cfg, place)
    except OmegaConfBaseException:
        return None


def _target(settings: Any, place: str) -> Callable[..., Any] | None:
    """What takes the settings of a place; None if that is not known, which `check` complains of."""
    if not isinstance(settings, DictConfig):
        return None
    if place == "robot" and "_target_" not in settings:
        return DifferentialDrive
    try:
        return find(_raw(settings, "_target_"), place)
    except InputError:
        return None


def _filled(target: Callable[..., Any], given: Mapping[str, Any]) -> Config:
    """Keys and their values, in the order of the target's own, with its defaults."""
    found = {"_target_": given["_target_"]} if "_target_" in given else {}
    for option in _options(target):
        default = _plain(option.default)
        if option.name not in given:
            found |= {} if default is _UNSET else {option.name: default}
        elif dataclasses.is_dataclass(option.default) and isinstance(given[option.name], dict):
            found[option.name] = _filled(type(option.default), given[option.name])
        else:
            found[option.name] = given[option.name]
    return {**found, **{name: value for name, value in given.items() if name not in found}}


def _options(target: Callable[..., Any]) -> list[Option]:
    """Options of what a configuration names; none of what has no signature."""
    try:
        return [option for option in described(target) if option.name not in _INJECTED]
    except ValueError:
        return []


def _plain(value: Any) -> Any:
    """A default as a configuration holds it; `_UNSET` for one that it cannot hold."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = dataclasses.asdict(value) if value is not dataclasses.MISSING else _UNSET
    if isinstance(value, Enum):
        value = value.value
    if isinstance(value, (list, tuple)):
        parts = [_plain(part) for part in value]
        return _UNSET if _UNSET in parts else parts
    if isinstance(value, dict):
        held = {str(name): _plain(part) for name, part in value.items()}
        return _UNSET if _UNSET in held.values() else held
    sound = value is None or isinstance(value, (str, bool, int, float))
    return value if sound and not _holds_nan(value) else _UNSET


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
        If there is no such group or sensor, or what the option names cannot be found.
    """
    require(group in GROUPS, f"no group {group}; there are: {', '.join(GROUPS)}")
    kind = sensor_class(name) if group == "sensors" else None
    if kind is not None:
        return "\n".join([f"{kind.__module__}.{kind.__qualname__}", *_said(kind, {})])
    option, _, only = name.partition(".")
    with initialize_config_dir(str(CONF), version_base="1.3"):
        cfg = compose("config", overrides=[*searched, f"{group}={option}"])
    places = [f"sensors.{sensor}" for sensor in cfg.sensors] if group == "sensors" else [group]
    if only:
        require(
            f"{group}.{only}" in places,
            f"no sensor {only} in {option}; there are: {', '.join(cfg.sensors)}",
        )
        places = [f"{group}.{only}"]
    parts = []
    for place in places:
        settings = OmegaConf.select(cfg, place)
        if settings is None:
            continue
        stated = OmegaConf.to_container(settings, resolve=False)
        called = stated.get("_target_", "")  # type: ignore[union-attr]
        target = find(called, place) if called or place != "robot" else DifferentialDrive
        parts.append("\n".join([place + (f": {called}" if called else ""), *_said(target, stated)]))  # type: ignore[arg-type]
    return "\n\n".join(parts)


def _said(target: Callable[..., Any], stated: Mapping[str, Any]) -> Iterator[str]:
    """A line for each option, and one of its meaning."""
    for option in _options(target):
        value = stated.get(option.name, option.default)
        shown = "needed" if value is dataclasses.MISSING else "null" if value is None else value
        if isinstance(value, bool):
            shown = str(value).lower()
        yield f"  {option.name}: {shown}" + (f"  ({option.accepts})" if option.accepts else "")
        if option.meaning:
            yield f"      {option.meaning}"


# What a configuration must hold


def check_known(key: str) -> None:
    """Check that a key is one of the configuration's own.

    Raises
    ------
    InputError
        Naming the known ones next to it.
    """
    place = key.rpartition(".")[0]
    require(
        key in _KEYS, unknown(key, (other for other in _KEYS if other.rpartition(".")[0] == place))
    )


def check_shape(config: Config) -> None:
    """Check that every key is there, holds keys or a path where it must, and nowhere NaN.

    Raises
    ------
    InputError
        Naming the key, and the remedy.
    """
    for key in _KEYS:
        parent, _, leaf = key.rpartition(".")
        if leaf not in (config[parent] if parent else config):
            remedy = f"choose one of `estima options {key}`" if key in GROUPS else "set it"
            raise InputError(f"{key} is missing; {remedy}")
        if key in _MAPPINGS and not isinstance(config[key], dict):
            raise InputError(f"{key} must hold keys, got {config[key]!r}")
    for place in ("simulation", "prior", "scoring"):
        for name in config[place]:
            check_known(f"{place}.{name}")
    wanted = config["recording"]
    if not (wanted is None or isinstance(wanted, dict) or (isinstance(wanted, str) and wanted)):
        got = "nothing" if wanted == "" else repr(wanted)
        raise InputError(f"recording must be a path, null, or a mapping with _target_, got {got}")
    for leaf_, value in leaves(config):
        require(not _holds_nan(value), f"{'.'.join(map(str, leaf_))} holds NaN; give a number")


def _holds_nan(value: Any) -> bool:
    """Whether a value is NaN, or a list or mapping that has one."""
    if isinstance(value, dict):
        return any(map(_holds_nan, value.values()))
    if isinstance(value, (list, tuple)):
        return any(map(_holds_nan, value))
    return isinstance(value, float) and math.isnan(value)


def own_config(config: Config, settings: TeamSettings, number: int) -> Config:
    """Configuration of one of the robots, which has no key `team`.

    Raises
    ------
    InputError
        If the robot has a key that its group has not.
    """
    own = {key: value for key, value in config.items() if key != "team"}
    for group, values in settings.robots[number].items():
        where = f"team.robots[{number}].{group}"
        require(group in _OWN, f"unknown key {where}; known: {', '.join(_OWN)}")
        require(isinstance(values, Mapping), f"{where} must hold keys, got {values!r}")
        for key in values:
            known = (f"{where}.{name}" for name in own[group])
            require(key in own[group], unknown(f"{where}.{key}", known))
        own[group] = {**own[group], **values}
    return own
