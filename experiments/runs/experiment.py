"""From the resolved configuration to the objects it names."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from estimators.base import Estimator, Prior
from experiments.runs.cache import cached
from experiments.runs.seeds import stream
from experiments.runs.version import ROOT
from sim.errors import InputError
from sim.recording import Recording, load
from sim.robot import DifferentialDrive, RobotGeometry
from sim.sensors import SensorSuite, suite_from_config
from sim.settings import build
from sim.world import World

Config = dict[str, Any]
SIMULATED_KEYS = ("world", "robot", "sensors", "route", "simulation", "seed", "world_seed")


def make(settings: Config, where: str, **injected: Any) -> Any:
    """Call what `_target_` names with the other keys.

    Parameters
    ----------
    settings
        A mapping with `_target_` (module.name) and keyword arguments.
    where
        Its place in the configuration, for messages.
    injected
        Further arguments, given by the program.

    Raises
    ------
    InputError
        If the target cannot be found, or a key is unknown or missing.
    """
    target = settings.get("_target_")
    if not isinstance(target, str) or "." not in target:
        raise InputError(f"{where}._target_ must name a class or function, such as mine.Mine")
    function = _find(target, where)
    arguments = {key: value for key, value in settings.items() if key != "_target_"}
    known = inspect.signature(function).parameters
    open_ended = any(p.kind is inspect.Parameter.VAR_KEYWORD for p in known.values())
    for key in arguments:
        if key not in known and not open_ended:
            free = ", ".join(k for k in known if k not in injected) or "none"
            raise InputError(f"unknown key {where}.{key} for {target}; known: {free}")
    for name, parameter in known.items():
        given = name in arguments or name in injected
        if parameter.default is inspect.Parameter.empty and not given and name != "self":
            if parameter.kind in (
                inspect.Parameter.VAR_KEYWORD,
                inspect.Parameter.VAR_POSITIONAL,
            ):
                continue
            raise InputError(f"{where}.{name} is missing; {target} needs it")
    try:
        return function(**arguments, **{k: v for k, v in injected.items() if k in known})
    except (TypeError, ValueError) as error:
        raise InputError(f"{where} ({target}) does not accept its values: {error}") from error


def _find(target: str, where: str) -> Callable[..., Any]:
    module_name, _, name = target.rpartition(".")
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        raise InputError(
            f"{where}._target_={target}: no module {error.name}; is its folder on PYTHONPATH?"
        ) from error
    found = getattr(module, name, None)
    if not callable(found):
        raise InputError(f"{where}._target_={target}: {module_name} has no class {name}")
    return found  # type: ignore[no-any-return]


def check(config: Config) -> None:
    """Build what is cheap to build, so that a wrong value is told before any time is spent."""
    for group in ("world", "robot", "sensors", "route", "simulation", "prior", "estimator"):
        if not isinstance(config[group], dict):
            raise InputError(f"{group} must hold keys, got {config[group]!r}")
    repeats, keep = config["repeats"], config["keep"]
    if isinstance(repeats, bool) or not isinstance(repeats, int) or repeats < 1:
        raise InputError(f"repeats must be a whole number from 1 on, got {repeats!r}")
    if not (isinstance(keep, list) and all(isinstance(key, str) for key in keep)):
        raise InputError(f"keep must be a list of names, such as [ess], got {keep!r}")
    make_robot(config)
    suite_from_config(config["sensors"])
    make(config["route"], "route")
    stream(config["seed"], "slip")
    stream(config["world_seed"], "world")


def make_world(config: Config) -> World:
    """World of the configuration, from its own stream."""
    rng = stream(config["world_seed"], "world")
    world: World = make(config["world"], "world", rng=rng)
    return world


def make_robot(config: Config) -> DifferentialDrive:
    """Robot of the configuration."""
    return build(DifferentialDrive, config["robot"], "robot")


def make_recording(
    config: Config, cache: Path, on_progress: Callable[[float], None] | None = None
) -> Recording:
    """Read, fetch from the cache, or simulate the configuration's recording.

    A mapping in place of a path names a function that makes one.
    """
    if isinstance(config["recording"], dict):
        made: Recording = make(config["recording"], "recording", config=config)
        return made
    if config["recording"] is not None:
        return load(Path(config["recording"]))
    return cached(cache, recording_settings(config), lambda: simulate(config, on_progress))


def recording_settings(config: Config) -> Config:
    """What decides the recording's bits, beside the code: its settings, or a file's digest."""
    if isinstance(config["recording"], dict):
        wanted = config["recording"]
        return {"recording": wanted, "seed": config["seed"], "files": files_digest(wanted)}
    if config["recording"] is not None:
        return {"recording": _digest(Path(config["recording"]))}
    settings = {key: config[key] for key in SIMULATED_KEYS}
    world_file = config["world"].get("path")
    if world_file is not None and Path(world_file).is_file():  # an edited file is another world
        settings["world_file"] = _digest(Path(world_file))
    return settings


def files_digest(tree: Any) -> dict[str, str]:
    """Digest of every file that a mapping names, and of the files in each folder it names."""
    if isinstance(tree, dict):
        return {k: v for value in tree.values() for k, v in files_digest(value).items()}
    if not isinstance(tree, str) or not Path(tree).name:
        return {}
    path = Path(tree)
    try:
        files = [path] if path.is_file() else sorted(path.glob("*")) if path.is_dir() else []
    except OSError:  # too long for a path, say
        return {}
    return {str(file): _digest(file) for file in files if file.is_file()}


def _digest(path: Path) -> str:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot read it ({error.strerror})") from error


def simulate(config: Config, on_progress: Callable[[float], None] | None = None) -> Recording:
    """Simulate the configuration's recording."""
    from sim.simulate import record

    simulation = config["simulation"]
    for key, allowed in (("physics", ("bullet", "kinematic")), ("rays", ("bullet", "exact"))):
        if simulation[key] not in allowed:
            raise InputError(
                f"simulation.{key} must be {' or '.join(allowed)}, got {simulation[key]!r}"
            )
    return record(
        make_world(config),
        make_robot(config),
        suite_from_config(config["sensors"]),
        make(config["route"], "route"),
        {axis: stream(config["seed"], axis) for axis in ("slip", "sensors")},
        physics=simulation["physics"],
        rays=simulation["rays"],
        config={key: config[key] for key in SIMULATED_KEYS},
        on_progress=on_progress,
    )


def make_estimator(config: Config) -> Estimator:
    """Estimator of the configuration; anything with `reset` and `step`."""
    estimator = make(config["estimator"], "estimator")
    for method in ("reset", "step"):
        if not callable(getattr(estimator, method, None)):
            raise InputError(
                f"estimator._target_={config['estimator']['_target_']} has no method {method}; "
                "see estimators/base.py for the protocol"
            )
    return estimator  # type: ignore[no-any-return]


def make_prior(config: Config, recording: Recording) -> Prior:
    """What the estimator knows at the start."""
    settings = config["prior"]
    believed = {key: settings[key] for key in ("wheel_radius_m", "track_m")}
    given = {key: value for key, value in believed.items() if value is not None}
    robot = build(RobotGeometry, dataclasses.asdict(recording.robot) | given, "prior")
    known_map = make_map(config, recording)
    sensors: SensorSuite = recording.sensors
    if settings["start"] == "global":
        return Prior(robot, sensors, map=known_map)
    if settings["start"] != "tracking":
        raise InputError(f"prior.start must be tracking or global, got {settings['start']!r}")
    sigma = [settings["sigma_position_m"]] * 2 + [settings["sigma_heading_rad"]]
    for key, value in zip(("sigma_position_m", "sigma_heading_rad"), sigma[1:], strict=True):
        if not (isinstance(value, (int, float)) and 0.0 <= value < np.inf):
            raise InputError(f"prior.{key} must be zero or positive, got {value}")
    start = np.zeros(3)
    if recording.truth is not None:
        start = recording.truth_at(recording.frame_stamps[:1])[0]
    offset = np.array(sigma) * stream(config["seed"], "prior").standard_normal(3)
    return Prior(robot, sensors, start + offset, np.diag(np.square(sigma)), known_map)


def make_map(config: Config, recording: Recording) -> Any:
    """Map of the prior: none, the recording's world, or what a mapping's function makes."""
    wanted = config["prior"]["map"]
    if isinstance(wanted, dict):
        return make(wanted, "prior.map", config=config, recording=recording)
    if wanted == "none":
        return None
    if wanted != "world":
        raise InputError(
            f"prior.map must be none, world or a mapping with _target_, got {wanted!r}"
        )
    world = recording.truth.world if recording.truth else None
    if world is None:
        raise InputError("prior.map=world, but the recording has no map; set prior.map=none")
    return world


def default_cache() -> Path:
    """Folder of the recordings' cache."""
    return ROOT / "results" / "cache" / "recordings"
