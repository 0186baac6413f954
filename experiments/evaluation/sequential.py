"""Confidence intervals for data that are looked at as they grow, with one error over all looks.

They are the repeated confidence intervals of a group-sequential design (Jennison and Turnbull 1989,
J. R. Stat. Soc. B 51(3)). The error is spent as the square of the share of the largest sample that
has been seen (Lan and DeMets 1983, Biometrika 70(3); Kim and DeMets 1987, Biometrika 74(1)). So one
may stop at any look, for any reason, and look as often as one likes, as long as the places of the
looks do not depend on the data. What is fixed beforehand is the largest sample.

The values are differences of logs between paired runs, whose unit is the recording; they are
unbounded, and some are skewed. At a look, the interval of their mean holds both the t interval and
that of Hall's transformed t (Hall 1992, J. R. Stat. Soc. B 54(1)), which corrects for skewness: the
t interval fails for skewed values, Hall's for heavy tails. Of the error of 5 % that is promised,
4 % are spent; the rest is for what skewness remains.

A confidence sequence needs no largest sample, but betting (Waudby-Smith and Ramdas 2024, J. R.
Stat. Soc. B 86(1)) needs bounded values, and the normal mixture of Robbins (Howard, Ramdas,
McAuliffe and Sekhon 2021, Ann. Statist. 49(2)), as the t-test e-process of Wang and Ramdas (2024,
arXiv:2310.03722), pays for looks that are never taken: on 20 to 200 recordings it spends some 2 %
of the error, and decides the smallest effect in 54 % of cases in place of 86 %.
`experiments.judging.sequential_power` compares them.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence

import numpy as np
import scipy
from numpy.typing import ArrayLike
from scipy.special import ndtr

from experiments.evaluation.statistics import Interval
from sim.arrays import Array
from sim.errors import require

SPENT = 0.04  # of the error of 5 %, over all looks
_GRID = 401  # places at which the score's density between the boundaries is kept


@functools.lru_cache(maxsize=256)
def look_errors(looks: tuple[int, ...], spent: float = SPENT) -> tuple[float, ...]:
    """Two-sided error of the interval at each look, such that all together err by `spent`.

    By the recursion of Armitage, McPherson and Rowe (1969) over the density of the normal score
    within the boundaries so far.

    Parameters
    ----------
    looks
        Recordings at each look, increasing; the last is the largest sample.
    spent
        Error over all looks, two-sided.

    Raises
    ------
    InputError
        If the looks do not increase from 2 at least.
    """
    grows = bool(looks) and looks[0] >= 2 and all(a < b for a, b in itertools.pairwise(looks))
    require(grows, f"looks {list(looks)}: must increase, from 2 recordings at least")
    times = np.array(looks) / looks[-1]
    errors: list[float] = []
    place, mass, before = np.zeros(1), np.ones(1), 0.0  # the score starts at 0
    for time, gain in zip(times, np.diff(spent * times**2, prepend=0.0), strict=True):
        step = math.sqrt(time - before)
        bound = float(
            scipy.optimize.brentq(
                lambda at, place, mass, step, gain: 2.0 * mass @ ndtr((place - at) / step) - gain,
                0.0,
                12.0 * math.sqrt(time),
                args=(place, mass, step, gain),
            )
        )
        errors.append(float(2.0 * ndtr(-bound / math.sqrt(time))))
        fresh = np.linspace(-bound, bound, _GRID)
        density = np.exp(-0.5 * ((fresh[:, None] - place) / step) ** 2) @ mass
        weights = np.r_[0.5, np.ones(_GRID - 2), 0.5] * (fresh[1] - fresh[0])
        place, mass = fresh, density * weights / (step * math.sqrt(2.0 * math.pi))
        before = time
    return tuple(errors)


def repeated_interval(values: ArrayLike, looks: Sequence[int], spent: float = SPENT) -> Interval:
    """Mean of independent values (N,), in their order, with its interval at the latest look.

    Values beyond that look wait for the next one; before the first there are no bounds.
    """
    sample = np.asarray(values, float)
    n = max((at for at in looks if at <= len(sample)), default=len(sample))
    sample = sample[:n]
    mean = float(sample.mean()) if n else math.nan
    reached = [error for at, error in zip(looks, look_errors(tuple(looks), spent), strict=True)
               if at <= n]  # fmt: skip
    if not reached or not math.isfinite(mean):
        return Interval(mean, math.nan, math.nan)
    off = sample - mean
    spread = float(np.sqrt((off**2).mean()))
    skewness = ((off / spread) ** 3).mean() if spread > 0.0 else 0.0
    low, high = skewed_bounds(n, sample.std(ddof=1), skewness, reached[-1])
    return Interval(mean, mean + float(low), mean + float(high))


def skewed_bounds(
    n: ArrayLike, deviation: ArrayLike, skewness: ArrayLike, error: ArrayLike
) -> tuple[Array, Array]:
    """Bounds of the mean less the mean: the wider of the t interval's and Hall's, on either side.

    Parameters
    ----------
    n, deviation, skewness
        Number of values, their standard deviation and their skewness, of any shape.
    error
        Two-sided.
    """
    count, root = np.asarray(n, float), np.sqrt(np.asarray(n, float))
    t, skew = scipy.stats.t.isf(np.asarray(error) / 2.0, count - 1.0), np.asarray(skewness) / root
    scale = np.asarray(deviation, float) / root
    low = -scale * np.maximum(t, _hall(t, skew))
    high = -scale * np.minimum(-t, _hall(-t, skew))
    return low, high


def _hall(x: Array, skew: Array) -> Array:
    """Inverse of Hall's (1992) monotone transformation of t; `skew` is over the root of n."""
    safe = np.where(np.abs(skew) < 1e-6, 1e-6, skew)
    return np.asarray(3.0 / safe * (np.cbrt(1.0 + safe * (x - safe / 6.0)) - 1.0))


def plan_looks(n_most: int, first: int = 20, count: int = 6) -> tuple[int, ...]:
    """Places of looks that grow by one factor, from `first` recordings to the largest sample."""
    places = np.geomspace(min(first, n_most), n_most, count).round().astype(int)
    return tuple(int(n) for n in np.unique(places))


def power_at(n: int, error: float, effect: float, spread: float) -> float:
    """Power that n recordings decide an effect, both in the values' unit.

    Parameters
    ----------
    error
        Two-sided.
    spread
        Standard deviation of the values.
    """
    return float(
        scipy.stats.norm.sf(scipy.stats.norm.isf(error / 2.0) - effect * math.sqrt(n) / spread)
    )


def recordings_for(effect: float, spread: float, power: float = 0.9, error: float = 0.05) -> int:
    """Recordings at which a test that looks once has the power; see `power_at`."""
    z = scipy.stats.norm.isf(error / 2.0) + scipy.stats.norm.ppf(power)
    return math.ceil(float(spread * z / effect) ** 2)
