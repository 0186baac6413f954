"""kr, kl and forward slip from what the wheels of a log leave unexplained over blocks of time."""

import math

import numpy as np
import scipy

from experiments.calibration.logs import slip_law
from experiments.evaluation.statistics import Interval, share_interval
from experiments.runs.calibration import Slip
from sim.arrays import Array, Bools, Ints

BLOCK_S = 4.0  # over which errors of the wheels are summed: stamps and starts cancel
N_RESAMPLES = 200
_MAX_LASTING = 10.0  # blocks; slip that lasts longer is a gain
_FAILED = 10.0  # robust deviations
_NO_SLIP_M = 1e-12  # kr or kl that is at its bound of zero


def slip_of_blocks(
    stamps: Array, off_m: Array, forward_m: Array, path_m: Array, rng: np.random.Generator
) -> tuple[Slip, dict[str, Interval]]:
    """kr, kl by the turns of blocks, times the track, and the forward slip that they leave.

    Blocks that are off by more than ten robust deviations are left out: there the reference failed.
    Both get what they have in common unless the log tells them apart: blocks in which both wheels
    roll alike say nothing of either, and a kr of zero would be believed. Forward slip lasts if the
    errors of a block and the next are alike.
    """
    sound = _sound(off_m, path_m) & _sound(forward_m, path_m)
    outliers = share_interval(int(np.sum(~sound)), len(sound))
    stamps, off_m, forward_m, path_m = (v[sound] for v in (stamps, off_m, forward_m, path_m))
    travel_m = path_m.mean(axis=1)
    joined = np.append(np.diff(stamps) < 1.5 * BLOCK_S, False)
    product = np.where(joined, forward_m * np.roll(forward_m, -1), 0.0)

    def law(rows: Ints, together: bool = False) -> Array:
        kr, kl = slip_law(off_m[rows] ** 2, path_m[rows])
        if together:
            kr = kl = np.sum(off_m[rows] ** 2) / np.sum(path_m[rows])
        more = forward_m[rows] ** 2 - path_m[rows] @ [kr, kl] / 4.0
        variance = max(float(np.mean(more)), 0.0)
        follows = rows[joined[rows]]
        alike = np.mean(product[follows]) / variance if variance and len(follows) else 0.0
        return np.array([kr, kl, variance / np.mean(travel_m[rows]), alike])

    n = len(path_m)
    every = np.arange(n)
    picks = rng.integers(n, size=(N_RESAMPLES, n))
    apart = np.array([law(pick) for pick in picks])
    difference = np.quantile(apart[:, 0] - apart[:, 1], [0.025, 0.975])
    at_zero = float(law(every)[:2].min()) <= _NO_SLIP_M
    together = bool(difference[0] <= 0.0 <= difference[1]) or at_zero
    spread = np.array([law(pick, True) for pick in picks]) if together else apart
    lasts = float(np.quantile(spread[:, 3], 0.025)) > 0.0
    block_m = float(np.mean(travel_m))

    def named(values: Array, blocks: float) -> Array:
        """kr, kl, forward slip per metre in the long run, and its length, m."""
        share = 1.0 - blocks * (1.0 - math.exp(-1.0 / blocks)) if blocks else 1.0
        return np.array([*values[:2], values[2] / share, blocks * block_m])

    lengths = [lasting_blocks(values[3]) for values in spread]
    drawn = [named(v, a if lasts else 0.0) for v, a in zip(spread, lengths, strict=True)]
    low, high = np.quantile(drawn, [0.025, 0.975], axis=0)
    if not lasts:
        high[3] = np.quantile(lengths, 0.975) * block_m
    whole = law(every, together)
    values = named(whole, lasting_blocks(whole[3]) if lasts else 0.0)
    names = ("kr", "kl", "forward_slip_m", "forward_slip_length_m")
    return Slip(**dict(zip(names, map(float, values), strict=True))), {
        f"slip.{name}": Interval(float(v), float(a), float(b))
        for name, v, a, b in zip(names, values, low, high, strict=True)
    } | {"wheels: outliers": outliers}


def _sound(off_m: Array, path_m: Array) -> Bools:
    """Which blocks' errors (B,) are not far beyond what most of them are by their travel."""
    size = np.abs(off_m) / np.sqrt(path_m.sum(axis=1))
    return np.asarray(size <= _FAILED * 1.4826 * np.median(size) + 1e-12)


def lasting_blocks(alike: float) -> float:
    """Length, in blocks, of an Ornstein-Uhlenbeck process from its integrals over blocks.

    Integrals over a block and the next correlate by (1 - e)^2 / (2 (a - 1 + e)), with e = exp(-a)
    and the length 1 / a blocks. At most `_MAX_LASTING` blocks.
    """

    def off(a: float) -> float:
        e = math.exp(-a)
        return (1.0 - e) ** 2 / (2.0 * (a - 1.0 + e)) - alike

    least, most = 1.0 / _MAX_LASTING, 1e3
    if off(most) >= 0.0:
        return 0.0
    return (
        1.0 / float(scipy.optimize.brentq(off, least, most)) if off(least) > 0.0 else _MAX_LASTING
    )
