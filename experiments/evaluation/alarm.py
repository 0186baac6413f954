"""Does a method notice that it is lost? Its alarms against the truth.

It is lost while its position is off by more than `LOST_M`, for `HOLD_S` at least. What it says is
its extra `lost`, if it gives one, else the standard deviation of its position along the worst
direction; an alarm stands while that is at or above a threshold. A loss is missed if no alarm
stands within `DELAY_S` of its beginning. False alarms are counted in windows of `WINDOW_S`, each as
one, that hold neither a loss nor the `DELAY_S` before or after one: a method that sees its error
grow warns before it is lost.
"""

import math
from collections.abc import Sequence
from numbers import Real
from typing import Any, NamedTuple

import numpy as np

from estimators.base import Estimate
from experiments.evaluation.metrics import position_errors_m
from sim.arrays import Array
from sim.errors import require

LOST_M, HOLD_S = 1.0, 2.0
DELAY_S = 10.0
WINDOW_S = 10.0


class Evidence(NamedTuple):
    """What a method said over a run.

    Attributes
    ----------
    peaks
        (L,) the most in the first `DELAY_S` of each loss.
    quiet
        (W,) the most in each window apart from them.
    """

    peaks: Array
    quiet: Array


def alarm_signal(estimate: Estimate) -> Array:
    """How lost a method says it is (T,): in its own unit, or m; infinite without a pose.

    Raises
    ------
    InputError
        If it says so by something that is not a finite number.
    """
    block, own = estimate.covariances[:, :2, :2], estimate.extras.get("lost", [])
    known = np.isfinite(estimate.means).all(axis=1) & np.isfinite(block).all(axis=(1, 2))
    signal = np.full(len(block), np.inf)
    if any(value is not None for value in own):
        signal[known] = stated_lost(estimate.stamps, own)[known]
    else:
        signal[known] = np.sqrt(np.maximum(np.linalg.eigvalsh(block[known])[:, -1], 0.0))
    return signal


def stated_lost(stamps: Array, own: Sequence[Any]) -> Array:
    """The extra `lost` (T,); where there is none, the last one, and 0 before the first.

    Raises
    ------
    InputError
        If one is not a finite number, which would neither miss a loss nor raise a false alarm.
    """
    stated, last = np.zeros(len(stamps)), 0.0
    for row, value in enumerate(own):
        if value is not None:
            require(
                isinstance(value, Real) and math.isfinite(value),
                f"extra lost at {stamps[row]:g} s must be a finite number or None, got {value!r}",
            )
            last = float(value)
        stated[row] = last
    return stated


def find_losses(stamps: Array, errors_m: Array) -> Array:
    """First and last stamp (L, 2), s, of each time of being lost.

    NaN errors are none: without a pose, a method says that it is lost.
    """
    beyond = np.concatenate([[False], errors_m > LOST_M, [False]])
    begin, end = np.flatnonzero(np.diff(beyond.astype(np.int8))).reshape(-1, 2).T
    spans = np.column_stack([stamps[begin], stamps[end - 1]])
    return np.asarray(spans[spans[:, 1] - spans[:, 0] >= HOLD_S])


def evidence_of(truth: Array, estimate: Estimate) -> Evidence:
    """Evidence of an estimate against the true poses (T, 3) at its stamps."""
    stamps, signal = estimate.stamps, alarm_signal(estimate)
    losses = find_losses(stamps, position_errors_m(truth, estimate.means))
    peaks = [
        signal[(stamps >= begin) & (stamps <= min(end, begin + DELAY_S))].max()
        for begin, end in losses
    ]
    apart = losses + np.array([-DELAY_S, DELAY_S])
    starts = np.arange(stamps[0], stamps[-1] - WINDOW_S + 1e-9, WINDOW_S)
    clear = [start for start in starts if not _meets(apart, start, start + WINDOW_S)]
    quiet = [signal[(stamps >= s) & (stamps < s + WINDOW_S)].max(initial=0.0) for s in clear]
    return Evidence(np.array(peaks, np.float64), np.array(quiet, np.float64))


def _meets(spans: Array, begin: float, end: float) -> bool:
    """Whether any of some spans (L, 2) shares time with another."""
    return bool(((begin < spans[:, 1]) & (end > spans[:, 0])).any())


def alarm_curve(runs: Sequence[Evidence]) -> Array:
    """Threshold, share of losses missed, and false alarms an hour (K, 3) of a method's runs.

    The thresholds are those at which another loss is missed, and an infinite one, without alarms.
    """
    peaks, quiet = (np.concatenate(parts) for parts in zip(*runs, strict=True))
    hours = np.float64(len(quiet) * WINDOW_S / 3600.0)
    thresholds = np.append(np.unique(peaks[np.isfinite(peaks)]), np.inf)
    missed = np.array([(peaks < threshold).sum() for threshold in thresholds])
    alarms = np.array([(quiet >= threshold).sum() for threshold in thresholds])
    # without losses or quiet hours there is no share and no rate
    with np.errstate(invalid="ignore"):
        return np.column_stack(
            [thresholds, missed / np.float64(len(peaks)), alarms / np.float64(hours)]
        )
