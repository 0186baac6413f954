"""Intervals and tests for the claims; the recording is the unit of inference."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

Array = NDArray[np.float64]
Verdict = Literal["reproduced", "not reproduced", "undecided"]


@dataclass(frozen=True)
class Interval:
    """An estimate and its 95 % confidence interval."""

    value: float
    low: float
    high: float


def verdict(interval: Interval, at_least: float = -math.inf, at_most: float = math.inf) -> Verdict:
    """Judge an interval against [at_least, at_most]: inside, wholly outside, or spanning."""
    if not (math.isfinite(interval.low) and math.isfinite(interval.high)):
        return "undecided"
    if interval.low >= at_least and interval.high <= at_most:
        return "reproduced"
    if interval.high < at_least or interval.low > at_most:
        return "not reproduced"
    return "undecided"


def mean_interval(values: ArrayLike) -> Interval:
    """Mean of independent values (N,) with its t interval."""
    sample = np.asarray(values, float)
    mean = float(sample.mean())
    if len(sample) < 2:
        return Interval(mean, math.nan, math.nan)
    half = float(stats.t.ppf(0.975, len(sample) - 1) * sample.std(ddof=1) / math.sqrt(len(sample)))
    return Interval(mean, mean - half, mean + half)


def share_interval(hits: int, trials: int) -> Interval:
    """Share of hits with its Clopper-Pearson interval."""
    found = stats.binomtest(hits, trials).proportion_ci(0.95, "exact")
    return Interval(hits / trials, float(found.low), float(found.high))


def bootstrap_interval(
    clusters: ArrayLike,
    statistic: Callable[[Array], float],
    rng: np.random.Generator,
    n_resamples: int = 2000,
) -> Interval:
    """Percentile bootstrap over the first axis: the recordings, with all that is nested inside."""
    data = np.asarray(clusters, float)
    draws = rng.integers(len(data), size=(n_resamples, len(data)))
    values = np.array([statistic(data[rows]) for rows in draws])
    low, high = np.quantile(values, [0.025, 0.975])
    return Interval(statistic(data), float(low), float(high))


def log_ratio_interval(first: ArrayLike, second: ArrayLike) -> Interval:
    """Geometric mean of the paired ratios first / second, with the t interval of its log."""
    logs = np.log(np.asarray(first, float)) - np.log(np.asarray(second, float))
    found = mean_interval(logs)
    return Interval(*(math.exp(v) for v in (found.value, found.low, found.high)))


def wilcoxon_p(first: ArrayLike, second: ArrayLike) -> float:
    """P of the one-sided signed-rank test that first is below second in paired logs."""
    logs = np.log(np.asarray(first, float)) - np.log(np.asarray(second, float))
    return float(stats.wilcoxon(logs, alternative="less").pvalue)


def equivalent(first: ArrayLike, second: ArrayLike, margin: float) -> tuple[Interval, float]:
    """Two one-sided t tests in paired logs that the ratio lies within 1 / (1 + m) and 1 + m.

    Returns the ratio's interval at 90 %, which is what the tests ask of, and the larger p.
    """
    logs = np.log(np.asarray(first, float)) - np.log(np.asarray(second, float))
    n, mean, error = len(logs), float(logs.mean()), float(logs.std(ddof=1)) / math.sqrt(len(logs))
    limit, half = math.log1p(margin), float(stats.t.ppf(0.95, n - 1)) * error
    p_low = float(stats.t.sf((mean + limit) / error, n - 1))
    p_high = float(stats.t.cdf((mean - limit) / error, n - 1))
    bounds = (math.exp(v) for v in (mean, mean - half, mean + half))
    return Interval(*bounds), max(p_low, p_high)


def page_trend_p(rows: ArrayLike) -> float:
    """P of Page's test that values (N, K) fall along the columns."""
    return float(stats.page_trend_test(-np.asarray(rows, float)).pvalue)


def anees_band(n_recordings: int, dof: int = 3) -> tuple[float, float]:
    """95 % band of the mean NEES of independent recordings, over its degrees of freedom."""
    low, high = stats.chi2.ppf([0.025, 0.975], dof * n_recordings)
    return float(low) / (dof * n_recordings), float(high) / (dof * n_recordings)
