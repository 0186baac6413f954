"""The known ways to an answer that an estimator should not see, each with a bait at its end.

A way is tried by changing what lies there: an estimator that keeps to its Frames, its prior and
what it draws says the same as before. So whatever it does to get there, what it says gives it away.
"""

import dataclasses
import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from estimators.base import Estimator, Prior
from sim.arrays import Array, Values
from sim.log import Log
from sim.recording import Frame, Recording, Truth, arrays_of, digest_of
from sim.worlds.world import World

Beliefs = tuple[Array, Array]


class _Seeds(np.random.bit_generator.ISpawnableSeedSequence):
    """A seed sequence with an entropy that decides nothing."""

    def __init__(self, entropy: int) -> None:
        self.entropy, self._own = entropy, np.random.SeedSequence(0)

    def generate_state(self, n_words: int, dtype: Any = np.uint32) -> Any:
        return self._own.generate_state(n_words, dtype)

    def spawn(self, n_children: int) -> Any:
        return self._own.spawn(n_children)


def find_cheats(new: Callable[[], Estimator], recording: Recording, prior: Prior) -> str:
    """What an estimator reads or changes that is not its own; empty if nothing was found.

    It runs over the first half of the recording.
    """
    half = max(len(recording.frame_stamps) // 2, 1)
    part = dataclasses.replace(recording.cut(half))
    digest = digest_of(arrays_of(part), {})
    toured = _baited_map(prior, part, [-1, 0])
    prior = _baited_map(prior, part, [0, -1])
    usual = _run(new, part, prior, 0)
    changed = digest_of(arrays_of(part), {}) != digest
    if changed or not _same(usual, _run(new, part, prior, 0)):
        return "changes the log behind its Frames (base, setflags)" if changed else ""
    found = []
    end_s = float(part.frame_stamps[-1])
    memory = "gc, frames of the stack, attributes"
    for way, place in (
        (f"the truth in memory ({memory})", _another_truth()),
        (f"readings to come (base of its Frames' arrays, {memory})", _another_future(end_s)),
    ):
        with place:
            if not _same(usual, _run(new, part, prior, 0)):
                found.append(way)
    if not _same(usual, _run(new, part, toured, 0)):
        found.append("start pose and tour of its map")
    if not _same(usual, _run(new, part, prior, 1)):
        found.append("the seed sequence of its generator")
    return f"its beliefs depend on {'; '.join(found)}" if found else ""


def _run(new: Callable[[], Estimator], recording: Recording, prior: Prior, entropy: int) -> Beliefs:
    """Means and covariances over baited Frames."""
    estimator = new()
    seeds: Any = _Seeds(entropy)
    rng = np.random.Generator(np.random.PCG64(seeds))
    estimator.reset(prior, rng)
    beliefs = [estimator.step(frame) for frame in _baited_frames(recording)]
    if hasattr(estimator, "finish"):
        estimator.finish()
    means, covariances = ([getattr(b, key) for b in beliefs] for key in ("mean", "covariance"))
    return np.array(means), np.array(covariances)


def _same(first: Beliefs, second: Beliefs) -> bool:
    return all(np.array_equal(a, b, equal_nan=True) for a, b in zip(first, second, strict=True))


def _baited_frames(recording: Recording) -> Iterator[Frame]:
    """Frames whose arrays are views of the log, as those that estimators get are not."""
    for frame in recording.frames():
        readings = {name: _view(recording.logs[name], frame.stamp) for name in frame.readings}
        yield dataclasses.replace(frame, readings=readings)


def _view(log: Log, stamp: float) -> dict[str, Values]:
    row: Any = int(np.searchsorted(log.stamps, stamp, side="right")) - 1
    rows = slice(*log.splits[row : row + 2]) if log.splits is not None else row
    return {key: v[rows if log.schema[key].ragged else row] for key, v in log.values.items()}


def _baited_map(prior: Prior, recording: Recording, visited: list[int]) -> Prior:
    """Prior whose map has a start and a tour in free space: the drive's poses of these Frames."""
    if not isinstance(prior.map, World) or recording.truth is None:
        return prior
    ends = recording.truth.poses[visited]
    known_map = dataclasses.replace(prior.map, start_pose=ends[0], waypoints=ends[:, :2])
    return dataclasses.replace(prior, map=known_map)


def _all_of(*kinds: type) -> list[Any]:
    """Every object of these classes that is alive."""
    return [each for each in gc.get_objects() if type(each) in kinds]


@contextmanager
def _replaced(changes: list[tuple[Any, dict[str, Any]]]) -> Iterator[None]:
    """Context in which frozen objects have other values of some fields."""
    before = [(one, {name: getattr(one, name) for name in fields}) for one, fields in changes]
    try:
        for one, fields in changes:
            vars(one).update(fields)
        yield
    finally:
        for one, fields in before:
            vars(one).update(fields)


def _another_truth() -> Any:
    """Context in which every truth in memory is elsewhere."""
    away = np.array([1.0, -2.0, 0.5])
    changes: list[tuple[Any, dict[str, Any]]] = [
        (truth, {"poses": truth.poses + away}) for truth in _all_of(Truth)
    ]
    starts = [truth.world for truth in _all_of(Truth) if truth.world is not None]
    changes += [
        (world, {"start_pose": world.start_pose + away, "waypoints": world.waypoints + away[:2]})
        for world in {id(world): world for world in starts}.values()
    ]
    return _replaced(changes)


def _another_future(end_s: float) -> Any:
    """Context in which every log in memory goes on otherwise after a time."""
    changes: list[tuple[Any, dict[str, Any]]] = []
    for log in _all_of(Log):
        row: Any = int(np.searchsorted(log.stamps, end_s, side="right"))
        values = {}
        for key, field in log.schema.items():
            first = log.splits[row] if field.ragged and log.splits is not None else row
            values[key] = log.values[key].copy()
            with np.errstate(invalid="ignore"):  # of beams that saw nothing
                values[key][first:] = values[key][first:][::-1] // 2
            values[key].setflags(write=False)
        changes.append((log, {"values": values}))
    return _replaced(changes)
