"""What gil2008 measures of a run besides path and map: associations, error on revisited ground."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from estimators.base import Estimate
from experiments.evaluation.metrics import position_errors_m, rms, travelled_m
from experiments.papers.gil2008.recordings import true_ids
from experiments.papers.gil2008.settings import LAG_M, SETTLED_M, WITHIN_M
from experiments.runs.row import Row
from sim.arrays import Array
from sim.recording import Recording

KEEP = ("associations", "resampled")  # Belief extras that `filter_scores` reads


def filter_scores(recording: Recording, online: Estimate) -> Row:
    """Shares of right associations, and of images at which a particle filter resampled."""
    given = online.extras["associations"]
    rows = [i for i, associations in enumerate(given) if associations is not None]
    if not rows:
        return {}
    scores: Row = {"right_share": right_share(recording, [given[i] for i in rows])}
    resampled = [online.extras["resampled"][i] for i in rows]
    if None not in resampled:
        scores["resampled_share"] = float(np.mean(resampled))
    return scores


def right_share(recording: Recording, associations: Sequence[NDArray[np.int64]]) -> float:
    """Share of observations associated with the right landmark.

    One that starts a landmark is right if that landmark had not been seen before.
    """
    true = true_ids(recording)
    given = np.concatenate(associations)
    first = np.zeros(len(true), bool)
    first[np.unique(true, return_index=True)[1]] = True
    right = np.where(given == np.arange(len(true)), first, true[given] == true)
    return float(np.mean(right & (given >= 0)))


def matching_precision(recording: Recording) -> float:
    """Share of observations whose descriptor is nearest to that of their landmark's first one."""
    descriptors, true = recording.log("stereo")["descriptors"], true_ids(recording)
    ids, first = np.unique(true, return_index=True)
    again = np.delete(np.arange(len(true)), first)
    nearest = np.argmax(descriptors[again] @ descriptors[first].T, axis=1)
    return float(np.mean(ids[nearest] == true[again]))


def on_revisited_ground(truth: Array) -> NDArray[np.bool_]:
    """Rows (T,) where the robot is within a metre of where it was at least 20 m of path ago."""
    travelled = travelled_m(truth)
    near = np.hypot(*(truth[:, None, :2] - truth[None, :, :2]).transpose(2, 0, 1)) < WITHIN_M
    return np.asarray(np.any(near & (travelled[:, None] - travelled > LAG_M), axis=1))


def revisit_ratio(truth: Array, means: Array) -> float:
    """RMS position error at later visits of places over that at the first visit of each.

    Every pose on revisited ground is paired with the first one near it. Places first visited on the
    first 20 m are left out: near the known start every error is small at first. NaN below ten
    pairs.
    """
    some, travelled = truth[::4, :2], travelled_m(truth)[::4]
    near = np.hypot(*(some[:, None] - some[None]).transpose(2, 0, 1)) < WITHIN_M
    before = near & (travelled[:, None] - travelled > LAG_M)
    first = np.argmax(before, axis=1)
    later = np.flatnonzero(before.any(axis=1) & (travelled[first] >= SETTLED_M))
    if len(later) < 10:
        return math.nan
    errors = position_errors_m(truth, means)[::4]
    return rms(errors[later]) / rms(errors[first[later]])
