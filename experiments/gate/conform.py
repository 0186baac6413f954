"""The checks that every estimator must pass.

An estimator may state `needs`, a set of names among `wheels`, `laser`, `landmarks`, `cloud`,
`place` and `map`, and `global_or_grid = True` if it cannot be equivariant to the last digit (a
grid, a global search): then it is compared in distribution.
"""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from estimators.base import Belief, Estimator, Prior
from experiments.runs.experiment import Experiment
from experiments.runs.seeds import stream
from sim import se2
from sim.errors import InputError
from sim.recording import Recording
from sim.robot import RobotGeometry
from sim.sensors import SensorSuite
from sim.world import World

Array = NDArray[np.float64]
Make = Callable[[], Estimator]
MOTION = np.array([3.0, -2.0, 0.7])  # the rigid motion of the world in the equivariance check
N_SEEDS = 30  # runs of each arm when compared in distribution
_SENSOR_OF = {"laser": "laser", "landmarks": "stereo", "cloud": "lidar3d"}
_LOG_OF = {"laser": "laser", "landmarks": "landmarks", "cloud": "clouds"}
# Wheels are in every recording; what a place descriptor comes from is no sensor of the suite.
_NEVER_MISSING = ("wheels", "place")
_GRAIN = np.array([0.05, 0.05, 0.02])  # what a grid may differ by when it is turned: m, m, rad


@dataclass(frozen=True)
class CheckResult:
    """Outcome of one check."""

    name: str
    passed: bool
    message: str


def check_estimator(
    make: Make, recording: Recording, prior: Prior, *, n_frames: int = 60
) -> list[CheckResult]:
    """Run all checks on the first Frames of a recording.

    Parameters
    ----------
    make
        Gives a new estimator, always the same one.
    recording, prior
        A run with what the estimator needs, and a tracking prior with a proper covariance.
    """
    short = recording.cut(min(n_frames, len(recording.frame_stamps)))
    checks: list[tuple[str, Callable[[], str]]] = [
        ("finite", lambda: _finite(make, short, prior)),
        ("covariance", lambda: _covariance(make, short, prior)),
        ("same seed, same bits", lambda: _repeatable(make, short, prior)),
        ("causal", lambda: _causal(make, short, prior)),
        ("frames untouched", lambda: _untouched(make, short, prior)),
        ("reset", lambda: _reset(make, short, prior)),
        ("equivariant", lambda: _equivariant(make, short.cut(30), prior)),
        ("missing sensor", lambda: _missing(make, short, prior)),
    ]
    results = []
    for name, check in checks:
        try:
            fault = check()
        except Exception as error:  # a check that cannot run has failed, whatever the reason
            fault = f"{type(error).__name__}: {error}"
        results.append(CheckResult(name, not fault, fault or "ok"))
    return results


def walk(
    estimator: Estimator, recording: Recording, prior: Prior, seed: int = 0
) -> tuple[Array, Array]:
    """Means (T, 3) and covariances (T, 3, 3) over a recording."""
    estimator.reset(prior, stream(seed, "conform"))
    return _collect([estimator.step(frame) for frame in recording.frames()])


def _collect(beliefs: Sequence[Belief]) -> tuple[Array, Array]:
    means = np.array([belief.mean for belief in beliefs])
    covariances = np.array([belief.covariance for belief in beliefs])
    return means, covariances


def _finite(make: Make, recording: Recording, prior: Prior) -> str:
    means, covariances = walk(make(), recording, prior)
    if means.shape[1:] != (3,) or covariances.shape[1:] != (3, 3):
        return f"mean and covariance have shapes {means.shape[1:]}, {covariances.shape[1:]}"
    bad = ~(np.isfinite(means).all(axis=1) & np.isfinite(covariances).all(axis=(1, 2)))
    return f"not finite from Frame {np.argmax(bad)} on" if bad.any() else ""


def _covariance(make: Make, recording: Recording, prior: Prior) -> str:
    """Symmetric and positive semi-definite, to 1e-9 of its largest entry, while it is finite."""
    _, covariances = walk(make(), recording, prior)
    covariances = covariances[np.isfinite(covariances).all(axis=(1, 2))]
    if len(covariances) == 0:
        return "never finite"
    size = np.maximum(np.abs(covariances).max(axis=(1, 2)), 1e-12)
    lopsided = np.abs(covariances - covariances.transpose(0, 2, 1)).max(axis=(1, 2)) > 1e-9 * size
    if lopsided.any():
        return f"not symmetric at Frame {np.argmax(lopsided)}"
    least = np.linalg.eigvalsh(covariances)[:, 0]
    negative = least < -1e-9 * size
    if negative.any():
        row = int(np.argmax(negative))
        return f"eigenvalue {least[row]:.2g} at Frame {row}"
    return ""


def _same(first: tuple[Array, Array], second: tuple[Array, Array]) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))


def _repeatable(make: Make, recording: Recording, prior: Prior) -> str:
    same = _same(walk(make(), recording, prior), walk(make(), recording, prior))
    return "" if same else "two new estimators with the same seed differ"


def _causal(make: Make, recording: Recording, prior: Prior) -> str:
    """Compare beliefs with those on the recording cut short."""
    whole = walk(make(), recording, prior)
    half = len(recording.frame_stamps) // 2
    cut = walk(make(), recording.cut(half), prior)
    if not _same((whole[0][:half], whole[1][:half]), cut):
        return f"the first {half} beliefs change when the recording ends there"
    return ""


def _untouched(make: Make, recording: Recording, prior: Prior) -> str:
    before = recording.checksum
    estimator = make()
    estimator.reset(prior, stream(0, "conform"))
    for i, frame in enumerate(recording.frames()):
        writable = _writable_copy(frame)
        kept = _writable_copy(frame)
        estimator.step(writable)
        for name, mine, theirs in _pairs(kept, writable):
            if not np.array_equal(mine, theirs, equal_nan=True):
                return f"step changed {name} of Frame {i}"
    return "" if recording.checksum == before else "the recording was changed"


def _writable_copy(value: Any) -> Any:
    """Deep copy of a Frame whose arrays can be written to, so that a fault shows as a change."""
    if isinstance(value, np.ndarray):
        return value.copy()
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        names = [f.name for f in dataclasses.fields(value)]
        return type(value)(**{name: _writable_copy(getattr(value, name)) for name in names})
    return value


def _pairs(first: Any, second: Any, prefix: str = "") -> list[tuple[str, Any, Any]]:
    if dataclasses.is_dataclass(first) and not isinstance(first, type):
        return [
            pair
            for f in dataclasses.fields(first)
            for pair in _pairs(getattr(first, f.name), getattr(second, f.name), f.name)
        ]
    return [(prefix, first, second)] if isinstance(first, np.ndarray) else []


def _reset(make: Make, recording: Recording, prior: Prior) -> str:
    estimator = make()
    first = walk(estimator, recording, prior)
    return "" if _same(first, walk(estimator, recording, prior)) else "a second run differs"


def _equivariant(make: Make, recording: Recording, prior: Prior) -> str:
    """Move the world; the beliefs must move with it."""
    moved = _moved_prior(prior)
    if not getattr(make(), "global_or_grid", False):
        here, there = walk(make(), recording, prior), walk(make(), recording, moved)
        if not all(np.isfinite(part).all() for part in (*here, *there)):
            return "not finite"
        tolerance = 1e-9 if _same(here, walk(make(), recording, prior, seed=1)) else 1e-6
        fault = _gap(here, there)
        return f"off by {fault:.2g} (allowed {tolerance:g})" if fault > tolerance else ""
    seeds = range(N_SEEDS)
    ends = np.array([walk(make(), recording, prior, seed)[0][-1] for seed in seeds])
    moved_ends = np.array([walk(make(), recording, moved, N_SEEDS + s)[0][-1] for s in seeds])
    return _differ(ends, se2.compose(se2.inverse(MOTION), moved_ends))


def _differ(first: Array, second: Array) -> str:
    """Tell whether two samples of poses (N, 3) have different means or spreads.

    Means may differ by 4 standard errors and a grain, standard deviations 3 times and a grain.
    """
    # Headings count from the common direction, so that none lies at the seam.
    headings = np.concatenate([first[:, 2], second[:, 2]])
    middle = np.array([0.0, 0.0, np.arctan2(np.sin(headings).sum(), np.cos(headings).sum())])
    samples = [np.column_stack([p[:, :2], se2.wrap(p[:, 2] - middle[2])]) for p in (first, second)]
    means, sigmas = (np.array([f(s, axis=0) for s in samples]) for f in (np.mean, np.std))
    gap, allowed = np.abs(means[1] - means[0]), _GRAIN + 4 * np.hypot(*sigmas) / len(first) ** 0.5
    for i, name in enumerate(("x, m", "y, m", "heading, rad")):
        if gap[i] > allowed[i]:
            return f"mean {name}: off by {gap[i]:.2g} (allowed {allowed[i]:.2g})"
        if sigmas[:, i].max() > 3 * sigmas[:, i].min() + _GRAIN[i]:
            return f"spread of {name}: {sigmas[0, i]:.2g} becomes {sigmas[1, i]:.2g}"
    return ""


def _gap(here: tuple[Array, Array], there: tuple[Array, Array]) -> float:
    expected = se2.compose(MOTION, here[0])
    difference = there[0] - expected
    difference[:, 2] = se2.wrap(difference[:, 2])
    turn = _turn()
    size = max(1.0, float(np.abs(here[1]).max()))
    spread = np.abs(there[1] - turn @ here[1] @ turn.T).max() / size
    return float(max(np.abs(difference).max(), spread))


def _turn() -> Array:
    cos, sin = np.cos(MOTION[2]), np.sin(MOTION[2])
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def _moved_prior(prior: Prior) -> Prior:
    known_map = prior.map
    if isinstance(known_map, World):
        known_map = move_world(known_map, MOTION)
    elif known_map is not None:
        if not hasattr(known_map, "moved"):
            raise InputError(
                f"a map of type {type(known_map).__name__} cannot be moved with the world; give "
                "it a method moved(T_new_old)"
            )
        known_map = known_map.moved(MOTION)
    if prior.mean is None or prior.covariance is None:
        return dataclasses.replace(prior, map=known_map)
    turn = _turn()
    return dataclasses.replace(
        prior,
        mean=se2.compose(MOTION, prior.mean),
        covariance=turn @ prior.covariance @ turn.T,
        map=known_map,
    )


def move_world(world: World, T_new_old: Array) -> World:
    """Return the world as seen from another map frame; places, being upright, are left out."""
    ends = se2.transform(T_new_old, world.walls.reshape(-1, 2)).reshape(-1, 4)
    landmarks = world.landmarks.copy()
    landmarks[:, :2] = se2.transform(T_new_old, landmarks[:, :2])
    return dataclasses.replace(
        world,
        walls=ends,
        landmarks=landmarks,
        places={},
        start_pose=se2.compose(T_new_old, world.start_pose),
        waypoints=se2.transform(T_new_old, world.waypoints),
    )


def _missing(make: Make, recording: Recording, prior: Prior) -> str:
    """Take away what the estimator needs; it must say so in one InputError."""
    for need in sorted(getattr(make(), "needs", ())):
        blind, poorer = recording, prior
        if need == "map":
            poorer = dataclasses.replace(prior, map=None)
        elif need in _SENSOR_OF:
            absent: dict[str, Any] = {_SENSOR_OF[need]: None}
            suite: SensorSuite = dataclasses.replace(prior.sensors, **absent)
            poorer = dataclasses.replace(prior, sensors=suite)
            no_log: dict[str, Any] = {_LOG_OF[need]: None}
            blind = dataclasses.replace(recording, sensors=suite, **no_log)
        elif need in _NEVER_MISSING:
            continue
        else:
            known = ", ".join([*_NEVER_MISSING, *_SENSOR_OF, "map"])
            return f"unknown need {need!r}; known: {known}"
        try:
            walk(make(), blind, poorer)
        except InputError as error:
            if "\n" in str(error):
                return f"without {need}: the message has several lines"
            continue
        return f"runs without {need}, which it says it needs"
    return ""


def conform_target(target: str, arguments: Sequence[str]) -> list[CheckResult]:
    """Check an estimator on a small recording.

    Parameters
    ----------
    target
        An option of conf/estimator, or MODULE:CLASS.
    arguments
        Hydra overrides of the option, or the constructor's arguments, key=value.
    """
    by_class = ":" in target or "." in target
    make = _of_class(target, arguments) if by_class else _of_option(target, arguments)
    recording, prior = place_example() if "place" in getattr(make(), "needs", ()) else example()
    return check_estimator(make, recording, prior)


def _of_option(name: str, overrides: Sequence[str]) -> Make:
    return Experiment.compose([f"estimator={name}", *overrides]).estimator


def _of_class(target: str, arguments: Sequence[str]) -> Make:
    module_name, _, name = target.rpartition(":" if ":" in target else ".")
    try:
        cls = getattr(importlib.import_module(module_name), name)
    except (ModuleNotFoundError, AttributeError) as error:
        raise InputError(f"{target}: {error}; is its folder on PYTHONPATH?") from error
    keywords: dict[str, Any] = {}
    for argument in arguments:
        key, equals, value = argument.partition("=")
        if not equals:
            raise InputError(f"{argument}: constructor arguments are key=value")
        keywords[key] = _value(value)
    try:
        cls(**keywords) if callable(cls) else None
    except TypeError as error:
        raise InputError(f"{target}: {error}; give its arguments as key=value") from error
    if not callable(getattr(cls, "step", None)):
        raise InputError(f"{target} has no method step; give MODULE:CLASS of an estimator")
    return lambda: cls(**keywords)


def place_example() -> tuple[Recording, Prior]:
    """Return a route of places, and a tracking prior with its map."""
    start = ["prior.start=tracking", "prior.sigma_position_m=0.5", "prior.sigma_heading_rad=0.1"]
    experiment = Experiment.compose(["study=maximo2024_umh", *start])
    recording = experiment.recording()
    return recording, experiment.prior(recording)


def _value(text: str) -> Any:
    try:
        return float(text) if any(c in text for c in ".eE") else yaml.safe_load(text)
    except (ValueError, yaml.YAMLError):
        return text


def example() -> tuple[Recording, Prior]:
    """Return a short recording with all sensors in a room, and a tracking prior with its map."""
    experiment = Experiment.compose(
        [
            "world=room",
            "sensors=lms291",
            "sensors.laser.rate_hz=10",
            "route.distance_m=4",
            "simulation.physics=kinematic",
        ]
    )
    sensors = experiment.config["sensors"]
    stereo = Experiment.compose(["sensors=stereo_pixel"]).config["sensors"]["stereo"]
    sensors = {**sensors, "stereo": {**stereo, "rate_hz": 5.0}}
    experiment = experiment.replaced(sensors=sensors)
    recording, robot = experiment.simulate(), experiment.robot()
    truth = recording.truth
    assert truth is not None
    spread = np.diag(np.square([0.02, 0.02, 0.01]))
    believed = RobotGeometry(robot.wheel_radius_m, robot.track_m)
    start = truth.poses[0].copy()
    return recording, Prior(believed, recording.sensors, start, spread, truth.world)
