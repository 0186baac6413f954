"""Where scans fit a grid map best, over all positions and headings, by correlation."""

import math
from dataclasses import dataclass

import numpy as np
from scipy import fft

from sim import se2
from sim.arrays import Array


@dataclass(frozen=True)
class GridFit:
    """The best pose (3,) in the grid's frame, and its score.

    The score is the share of beams that end in occupied cells, less the share whose midpoints do:
    1 for a perfect map, about 0 for an inverted one.
    """

    pose: Array
    score: float


def beam_points(ranges_m: Array, bearings_rad: Array, T_base_laser: Array, poses: Array) -> Array:
    """Ends and midpoints of all beams with a return, of scans (S, beams) taken at poses (S, 3).

    Returns
    -------
    Array
        (N, 2, 2): end and midpoint of each beam.
    """
    lasers = se2.compose(poses, T_base_laser)
    angle = lasers[:, 2:] + bearings_rad
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    seen = np.isfinite(ranges_m)
    origin = np.broadcast_to(lasers[:, None, :2], direction.shape)[seen]
    ray = direction[seen] * ranges_m[seen][:, None]
    return np.stack([origin + ray, origin + ray / 2.0], axis=1)


def best_fit(occupancy: Array, cell_m: float, points: Array, n_headings: int = 90) -> GridFit:
    """The pose from which points (N, 2, 2) of `beam_points` fit the map best.

    Parameters
    ----------
    occupancy
        (X, Y) probability, NaN where unknown: such cells count as neither.
    cell_m
        Side of a cell.
    """
    known = np.nan_to_num(occupancy, nan=0.0)
    reach = math.ceil(float(np.abs(points).max()) / cell_m) + 2
    size = tuple(fft.next_fast_len(n + reach, real=True) for n in known.shape)
    spectrum = fft.rfft2(known, size)
    best = GridFit(np.zeros(3), -math.inf)
    for heading in np.arange(n_headings) * 2.0 * math.pi / n_headings:
        kernel = np.zeros(size)
        turned = se2.transform(np.array([0.0, 0.0, heading]), points.reshape(-1, 2))
        cells = np.round(turned / cell_m).astype(np.int64).reshape(points.shape)
        for i, weight in ((0, 1.0), (1, -1.0)):
            # cells that wrap around lie outside the map for every position considered
            np.add.at(kernel, (cells[:, i, 0] % size[0], cells[:, i, 1] % size[1]), weight)
        scores = fft.irfft2(spectrum * np.conj(fft.rfft2(kernel)), size)
        scores = scores[: known.shape[0], : known.shape[1]] / len(points)
        at = np.unravel_index(int(np.argmax(scores)), scores.shape)
        if scores[at] > best.score:
            x, y = ((int(i) + 0.5) * cell_m for i in at)
            best = GridFit(np.array([x, y, float(se2.wrap(heading))]), float(scores[at]))
    return best
