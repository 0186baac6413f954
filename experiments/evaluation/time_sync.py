"""Two trajectories with clocks of their own: which poses belong together."""

import numpy as np
from numpy.typing import NDArray

from experiments.evaluation.metrics import align, position_errors_m, rms
from sim import se2
from sim.arrays import Array
from sim.errors import require

Rows = NDArray[np.int64]


def nearest_rows(stamps: Array, wanted: Array) -> Rows:
    """Row of the stamp nearest to each wanted one (the earlier of two); stamps increasing."""
    if len(stamps) < 2:
        return np.zeros(np.shape(wanted), np.int64)
    after = np.clip(np.searchsorted(stamps, wanted), 1, len(stamps) - 1)
    before_is_nearer = wanted - stamps[after - 1] <= stamps[after] - wanted
    return np.where(before_is_nearer, after - 1, after).astype(np.int64)


def interpolate(stamps: Array, poses: Array, wanted: Array, longest_gap_s: float = np.inf) -> Array:
    """Poses at wanted times (...,) between poses (T, 3): straight lines, the shorter way round.

    NaN outside their span, and in gaps longer than `longest_gap_s`. Stamps increasing.
    """
    last = np.clip(np.searchsorted(stamps, wanted, side="right"), 1, len(stamps) - 1)
    span = stamps[last] - stamps[last - 1]
    share = ((wanted - stamps[last - 1]) / span)[..., None]
    in_gap = (span > longest_gap_s) & (wanted > stamps[last - 1])
    out: Array = poses[last - 1] + share * se2.difference(poses[last], poses[last - 1])
    out[..., 2] = se2.wrap(out[..., 2])
    out[(wanted < stamps[0]) | (wanted > stamps[-1]) | in_gap] = np.nan
    return out


def aligned_ate_m(
    truth_stamps: Array, truth: Array, stamps: Array, poses: Array, longest_gap_s: float = 3.0
) -> float:
    """RMS position error, m, after SE(2) alignment of an estimate with clocks of its own.

    The estimate is interpolated at the truth's stamps; those in its gaps are left out.

    Raises
    ------
    InputError
        If fewer than three stamps remain.
    """
    estimate = interpolate(stamps, poses, truth_stamps, longest_gap_s)
    known = np.isfinite(estimate).all(axis=1)
    require(known.sum() >= 3, "fewer than three true poses lie within the estimate's time span")
    return rms(position_errors_m(truth[known], align(truth[known], estimate[known])))
