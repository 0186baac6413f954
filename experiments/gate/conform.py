"""The checks that every estimator must pass.

An estimator may state `needs`: see `estimators.base.Estimator`. If it cannot be equivariant to
the last digit (a grid, a global search), it states `global_or_grid = True` and is compared in
distribution.
"""

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import yaml
from omegaconf import OmegaConf

from estimators.base import Estimator, Prior
from experiments.evaluation.alarm import stated_lost
from experiments.evaluation.recording_bound import bound_recording
from experiments.evaluation.statistics import BELOW_BOUND, over_bound
from experiments.gate.cheats import find_cheats
from experiments.runs.experiment import Experiment
from experiments.runs.seeds import stream
from experiments.runs.targets import make
from sim import se2
from sim.arrays import Array
from sim.errors import InputError, require
from sim.recording import Frame, Recording, arrays_of, digest_of
from sim.worlds.world import World

Make = Callable[[], Estimator]
MOTION = np.array([3.0, -2.0, 0.7])  # the rigid motion of the world in the equivariance check
_COS, _SIN = np.cos(MOTION[2]), np.sin(MOTION[2])
_TURN = np.array([[_COS, -_SIN, 0.0], [_SIN, _COS, 0.0], [0.0, 0.0, 1.0]])
N_SEEDS = 30  # runs of each arm when compared in distribution
_GRAIN = np.array([0.05, 0.05, 0.02])  # how far a grid may be off once turned: m, m, rad
_N_DRIVES = 5  # on which errors below the bound are looked for
# Recordings to check on, each with a tracking prior and its map
_ROOM = (
    "world=room",
    "sensors=laser_stereo",
    "sensors.stereo.rate_hz=5",
    "sensors.stereo.max_observations=0",
    "sensors.stereo.correlated=true",
    "route.distance_m=4",
    "simulation.physics=kinematic",
    "prior.start=tracking",
    "prior.sigma_position_m=0.02",
    "prior.sigma_heading_rad=0.01",
    "prior.map=world",
)
_PLACES = (
    "study=maximo2024/umh",
    "prior.start=tracking",
    "prior.sigma_position_m=0.5",
    "prior.sigma_heading_rad=0.1",
)


@dataclass(frozen=True)
class CheckResult:
    """Outcome of one check."""

    name: str
    passed: bool
    message: str


def check_estimator(
    make_estimator: Make, recording: Recording, prior: Prior, *, n_frames: int = 60
) -> list[CheckResult]:
    """Run all checks on the first Frames of a recording.

    Parameters
    ----------
    make_estimator
        Makes a new estimator, equal each time.
    recording, prior
        A run with what the estimator needs, and a tracking prior with a proper covariance.
    """
    short = recording.cut(min(n_frames, len(recording.frame_stamps)))
    results: list[CheckResult] = []
    for name, check in _CHECKS.items():
        try:
            fault = check(make_estimator, short, prior)
        except Exception as error:  # a check that cannot run has failed, whatever the reason
            fault = f"{type(error).__name__}: {error}"
        known = any(fault == result.message for result in results)  # a crash meets every check
        results.append(CheckResult(name, not fault, "as above" if known else fault or "ok"))
    return results


def walk(
    estimator: Estimator, recording: Recording, prior: Prior, seed: int = 0
) -> tuple[Array, Array]:
    """Means (T, 3) and covariances (T, 3, 3) over a recording; of `finish`, if it answers there."""
    estimator.reset(prior, stream(seed, "conform"))
    beliefs = [estimator.step(frame) for frame in recording.frames()]
    if _answers_at_finish(estimator):
        found = estimator.finish()  # type: ignore[attr-defined]
        return found.means, found.covariances
    return np.array([b.mean for b in beliefs]), np.array([b.covariance for b in beliefs])


def _answers_at_finish(estimator: Estimator) -> bool:
    return bool(getattr(estimator, "answers_at_finish", False))


def _finite(new: Make, recording: Recording, prior: Prior) -> str:
    means, covariances = walk(new(), recording, prior)
    if means.shape[1:] != (3,) or covariances.shape[1:] != (3, 3):
        return f"mean and covariance have shapes {means.shape[1:]}, {covariances.shape[1:]}"
    bad = ~(np.isfinite(means).all(axis=1) & np.isfinite(covariances).all(axis=(1, 2)))
    return f"not finite from Frame {np.argmax(bad)} on" if bad.any() else ""


def _lost(new: Make, recording: Recording, prior: Prior) -> str:
    """If it gives an extra `lost`, that is a finite number."""
    estimator = new()
    estimator.reset(prior, stream(0, "conform"))
    own = [estimator.step(frame).extras.get("lost") for frame in recording.frames()]
    try:
        stated_lost(recording.frame_stamps, own)
    except InputError as error:
        return str(error)
    return ""


def _covariance(new: Make, recording: Recording, prior: Prior) -> str:
    """Symmetric and positive semi-definite, to 1e-9 of its largest entry, while it is finite."""
    _, covariances = walk(new(), recording, prior)
    covariances = covariances[np.isfinite(covariances).all(axis=(1, 2))]
    if len(covariances) == 0:
        return "never finite"
    slack = 1e-9 * np.maximum(np.abs(covariances).max(axis=(1, 2)), 1e-12)
    lopsided = np.abs(covariances - covariances.transpose(0, 2, 1)).max(axis=(1, 2)) > slack
    if lopsided.any():
        return f"not symmetric at Frame {np.argmax(lopsided)}"
    smallest = np.linalg.eigvalsh(covariances)[:, 0]
    for frame in np.flatnonzero(smallest < -slack):
        return f"eigenvalue {smallest[frame]:.2g} at Frame {frame}"
    return ""


def _same(first: tuple[Array, Array], second: tuple[Array, Array]) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))


def _repeatable(new: Make, recording: Recording, prior: Prior) -> str:
    first, second = (walk(new(), recording, prior) for _ in range(2))
    return "" if _same(first, second) else "two new estimators with the same seed differ"


def _causal(new: Make, recording: Recording, prior: Prior) -> str:
    """Compare beliefs with those on the recording cut short."""
    if _answers_at_finish(new()):
        return ""  # its answer may see all
    whole = walk(new(), recording, prior)
    half = len(recording.frame_stamps) // 2
    same = _same((whole[0][:half], whole[1][:half]), walk(new(), recording.cut(half), prior))
    return "" if same else f"the first {half} beliefs change when the recording ends there"


def _untouched(new: Make, recording: Recording, prior: Prior) -> str:
    before = digest_of(arrays_of(recording), {})
    estimator = new()
    estimator.reset(prior, stream(0, "conform"))
    for i, frame in enumerate(recording.frames()):
        writable = dataclasses.replace(
            frame,
            wheel_increments_m=frame.wheel_increments_m.copy(),
            readings={
                sensor: {name: values.copy() for name, values in reading.items()}
                for sensor, reading in frame.readings.items()
            },
        )
        kept = {name: values.copy() for name, values in _arrays(writable).items()}
        estimator.step(writable)
        for name, values in _arrays(writable).items():
            if not np.array_equal(kept[name], values, equal_nan=True):
                return f"step changed {name} of Frame {i}"
    return "" if digest_of(arrays_of(recording), {}) == before else "the recording was changed"


def _arrays(frame: Frame) -> dict[str, Array]:
    """Arrays of a Frame, and of what it holds, by the names of their fields."""
    found = {"wheel_increments_m": frame.wheel_increments_m}
    for sensor, reading in frame.readings.items():
        found |= {f"{sensor}.{name}": values for name, values in reading.items()}
    return found


def _reset(new: Make, recording: Recording, prior: Prior) -> str:
    estimator = new()
    first = walk(estimator, recording, prior)
    return "" if _same(first, walk(estimator, recording, prior)) else "a second run differs"


def _equivariant(new: Make, recording: Recording, prior: Prior) -> str:
    """Move the world; the beliefs must move with it."""
    recording, moved = recording.cut(30), _moved_prior(prior)
    elsewhere = _moved_readings(recording)
    if not getattr(new(), "global_or_grid", False):
        here, there = walk(new(), recording, prior), walk(new(), elsewhere, moved)
        if not all(np.isfinite(part).all() for part in (*here, *there)):
            return "not finite"
        tolerance = 1e-9 if _same(here, walk(new(), recording, prior, seed=1)) else 1e-6
        fault = _gap(here, there)
        return f"off by {fault:.2g} (allowed {tolerance:g})" if fault > tolerance else ""
    seeds = range(N_SEEDS)
    ends = np.array([walk(new(), recording, prior, seed)[0][-1] for seed in seeds])
    moved_ends = np.array([walk(new(), elsewhere, moved, N_SEEDS + s)[0][-1] for s in seeds])
    return _differ(ends, se2.compose(se2.inverse(MOTION), moved_ends))


def _moved_readings(recording: Recording) -> Recording:
    """Return the recording with readings of places in map, as a beacon's, in the moved map."""
    for name, log in recording.logs.items():
        values = dict(log.values)
        for key in (key for key, field in log.schema.items() if field.in_map):
            values[key] = values[key].copy()
            flat = values[key][..., :2].reshape(-1, 2).astype(np.float64)
            values[key][..., :2] = se2.transform(MOTION, flat).reshape(values[key][..., :2].shape)
        recording = recording.with_log(name, dataclasses.replace(log, values=values))
    return recording


def _differ(first: Array, second: Array) -> str:
    """Say how two samples of poses (N, 3) differ in mean or spread; nothing if they do not.

    Means may differ by 4 standard errors and a grain, standard deviations by a factor of 3 and a
    grain.
    """
    # Headings count from the common direction, so that none lies at the seam.
    headings = np.concatenate([first[:, 2], second[:, 2]])
    middle = np.arctan2(np.sin(headings).sum(), np.cos(headings).sum())
    samples = [np.column_stack([p[:, :2], se2.wrap(p[:, 2] - middle)]) for p in (first, second)]
    means, sigmas = (np.array([f(s, axis=0) for s in samples]) for f in (np.mean, np.std))
    gap, allowed = np.abs(means[1] - means[0]), _GRAIN + 4 * np.hypot(*sigmas) / len(first) ** 0.5
    for i, name in enumerate(("x, m", "y, m", "heading, rad")):
        if gap[i] > allowed[i]:
            return f"mean {name}: off by {gap[i]:.2g} (allowed {allowed[i]:.2g})"
        if sigmas[:, i].max() > 3 * sigmas[:, i].min() + _GRAIN[i]:
            return f"spread of {name}: {sigmas[0, i]:.2g} becomes {sigmas[1, i]:.2g}"
    return ""


def _gap(here: tuple[Array, Array], there: tuple[Array, Array]) -> float:
    """Largest difference of means and covariances once both are in the moved frame."""
    difference = se2.difference(there[0], se2.compose(MOTION, here[0]))
    size = max(1.0, float(np.abs(here[1]).max()))
    spread = np.abs(there[1] - _TURN @ here[1] @ _TURN.T).max() / size
    return float(max(np.abs(difference).max(), spread))


def _moved_prior(prior: Prior) -> Prior:
    known_map = prior.map
    if isinstance(known_map, World):
        known_map = move_world(known_map, MOTION)
    elif known_map is not None:
        require(
            hasattr(known_map, "moved"),
            f"a map of type {type(known_map).__name__} cannot be moved with the world; give "
            "it a method moved(T_new_old)",
        )
        known_map = known_map.moved(MOTION)
    if prior.mean is None or prior.covariance is None:
        return dataclasses.replace(prior, map=known_map)
    return dataclasses.replace(
        prior,
        mean=se2.compose(MOTION, prior.mean),
        covariance=_TURN @ prior.covariance @ _TURN.T,
        map=known_map,
    )


def move_world(world: World, T_new_old: Array) -> World:
    """Return the map as seen from another frame; places, being upright, are left out."""
    ends = se2.transform(T_new_old, world.walls.reshape(-1, 2)).reshape(-1, 4)
    landmarks = world.landmarks.copy()
    landmarks[:, :2] = se2.transform(T_new_old, landmarks[:, :2])
    return dataclasses.replace(world.as_map(), walls=ends, landmarks=landmarks, places={})


def _missing(new: Make, recording: Recording, prior: Prior) -> str:
    """Take away what the estimator needs; it must then raise an InputError of one line."""
    for need in sorted(getattr(new(), "needs", ())):
        blind, poorer, estimator = recording, prior, new()
        if need == "map":
            poorer = dataclasses.replace(prior, map=None)
        else:
            for option in need.split("|"):
                blind = blind.without(getattr(estimator, option, option))
            poorer = dataclasses.replace(prior, sensors=blind.sensors)
        with contextlib.suppress(InputError):  # of one line always
            walk(new(), blind, poorer)
            return f"runs without {need}, which it says it needs"
    return ""


def find_below_bound(new: Make, drives: Sequence[tuple[Recording, Prior]]) -> CheckResult:
    """Check that errors over drives are not smaller than any method's that is shown what it needs.

    Sensors that it does not need, and the map, are taken away. It passes where there is no bound,
    as for a laser without a map, and says so.
    """
    passed = functools.partial(CheckResult, "not below the bound", True)
    needs: frozenset[str] = getattr(new(), "needs", frozenset())
    squares: list[Array] = []
    named = {getattr(new(), option, option) for need in needs for option in need.split("|")}
    for given, prior in drives:
        recording = given
        for name in set(given.sensors) - named:
            recording = recording.without(name)
        shown = prior.map if "map" in needs else None
        poorer = dataclasses.replace(prior, sensors=recording.sensors, map=shown)
        least = bound_recording(recording, poorer, recording.sensors)
        if least is None:
            return passed("no bound with what it needs, so not compared")
        try:
            means, _ = walk(new(), recording, poorer)
        except InputError as error:
            return passed(f"not compared, since it needs more than it says: {error}")
        if len(means) != len(least.revised) or not np.isfinite(means).all():
            return passed("not compared, since it has no pose at times")
        off = se2.difference(means, recording.truth_at(recording.frame_stamps))
        spread = np.diagonal(least.revised, axis1=1, axis2=2)
        squares.append(np.vstack([off**2, spread]).reshape(2, -1, 3).mean(axis=1))
    errors, bounds = np.array(squares).transpose(1, 0, 2)
    for kind, part in (("position", slice(0, 2)), ("heading", slice(2, 3))):
        ratio, p = over_bound(errors[:, part].sum(axis=1), bounds[:, part].sum(axis=1))
        if p < BELOW_BOUND:
            fault = f"{kind} errors are {ratio.value:.2g} times the least of any honest method"
            return CheckResult("not below the bound", False, fault)
    return passed("ok")


_CHECKS: Mapping[str, Callable[[Make, Recording, Prior], str]] = {
    "finite": _finite,
    "covariance": _covariance,
    "lost": _lost,
    "same seed, same bits": _repeatable,
    "causal": _causal,
    "frames untouched": _untouched,
    "only its Frames": find_cheats,
    "reset": _reset,
    "equivariant": _equivariant,
    "missing sensor": _missing,
}


def conform_target(
    target: str, arguments: Sequence[str], searched: Sequence[str] = ()
) -> list[CheckResult]:
    """Check an estimator on a small recording.

    Parameters
    ----------
    target
        An option of conf/estimator, or MODULE:CLASS.
    arguments
        Hydra overrides of the option, or the constructor's arguments, key=value; overrides of
        `sensors` say what the recording is made with.
    searched
        Override that names where else options are.
    """
    sensors = [a for a in arguments if a.lstrip("+~").startswith("sensors")]
    if ":" in target or "." in target:
        new = _of_class(target, [a for a in arguments if a not in sensors])
    else:
        new = Experiment.compose([*searched, f"estimator={target}", *arguments]).estimator
    places = "place|lidar3d" in getattr(new(), "needs", ())
    results = check_estimator(new, *example([*searched, *sensors], places=places))
    if places or not all(result.passed for result in results if result.name == "finite"):
        return results
    drives = [_drive((*searched, *sensors), seed) for seed in range(_N_DRIVES)]
    return [*results, find_below_bound(new, drives)]


@functools.cache
def _drive(overrides: tuple[str, ...], seed: int) -> tuple[Recording, Prior]:
    return example([*overrides, f"seed={seed}"])


def _of_class(target: str, arguments: Sequence[str]) -> Make:
    settings: Any = {"_target_": target.replace(":", ".")}
    remedy = "give MODULE:CLASS of an estimator, and its arguments as key=value"
    for argument in arguments:
        require("=" in argument, f"{argument}: constructor arguments are key=value")
    try:
        settings |= OmegaConf.to_object(OmegaConf.from_dotlist(list(arguments)))
        estimator = make(settings, "estimator")
    except (InputError, yaml.YAMLError) as error:
        raise InputError(f"{str(error).splitlines()[0]}; {remedy}") from error
    require(callable(getattr(estimator, "step", None)), f"{target} has no method step; {remedy}")
    return lambda: make(settings, "estimator")


def example(sensors: Sequence[str] = (), *, places: bool = False) -> tuple[Recording, Prior]:
    """Return a short recording, and a tracking prior with its map.

    Parameters
    ----------
    sensors
        Overrides of the sensors.
    places
        A route of place descriptors, instead of a room seen by all other sensors but the 3D lidar.
    """
    usual: tuple[str, ...] = _PLACES if places else _ROOM
    if any(override.startswith("sensors=") for override in sensors):
        usual = tuple(override for override in usual if not override.startswith("sensors"))
    experiment = Experiment.compose([*usual, *sensors])
    recording = experiment.recording()
    return recording, experiment.prior(recording)
