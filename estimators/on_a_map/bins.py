"""Bins of pose, by whose number in use the particles are counted (KLD sampling; Fox 2003)."""

import math

import numpy as np

from estimators.on_a_map.likelihood_field import LikelihoodField
from sim.arrays import Array, Ints
from sim.errors import require
from sim.options import NonNegative, Positive, options

_MOST_BINS = 250_000_000  # 2 GB


@options("estimator")
class BinOptions:
    """Bins of pose, and how near to the belief a draw must come."""

    kld_error: Positive = 0.05
    """KLD sampling: the draw differs from the belief by at most this much."""
    kld_quantile: NonNegative = 2.33
    """Standard normal quantile of the probability of that (2.33: 99 %)."""
    bin_m: Positive = 0.5
    """Side of the bins that KLD sampling counts, m."""
    bin_rad: Positive = 0.17
    """Width of the bins in heading, rad."""


class Bins:
    """Bins of pose over a field.

    Raises
    ------
    InputError
        If there would be too many.
    """

    def __init__(self, field: LikelihoodField, believed: BinOptions) -> None:
        self._believed, self._origin_m = believed, field.origin_m
        sides_m = field.cell_m * np.array(field.table.shape[::-1])
        sizes = [*sides_m / believed.bin_m, 2.0 * math.pi / believed.bin_rad]
        with np.errstate(over="ignore"):  # counted in floats, which do not wrap
            shape = np.ceil(np.array(sizes))
            n_bins = float(np.prod(shape))
        require(
            n_bins <= _MOST_BINS,
            f"estimator.bin_m={believed.bin_m} and bin_rad={believed.bin_rad} make {n_bins:.3g} "
            "bins of the map; make them larger",
        )
        self._shape: list[int] = shape.astype(int).tolist()

    def number(self, poses: Array) -> Ints:
        """Number of the bin (M,) of each pose (M, 3); poses off the map go to bins at its edge."""
        columns, rows, n_headings = self._shape
        x, y = ((poses[:, i] - self._origin_m[i]) / self._believed.bin_m for i in (0, 1))
        heading = np.floor((poses[:, 2] + math.pi) / self._believed.bin_rad).astype(np.int64)
        column = np.clip(x.astype(np.int64), 0, columns - 1)
        row = np.clip(y.astype(np.int64), 0, rows - 1)
        return np.asarray((row * columns + column) * n_headings + heading % n_headings)

    def count_particles(self, poses: Array) -> int:
        """Particles that the number of bins in use by poses (M, 3) calls for."""
        k = len(np.unique(self.number(poses)))
        if k < 2:
            return 1
        a = 2.0 / (9.0 * (k - 1))
        cube = (1.0 - a + math.sqrt(a) * self._believed.kld_quantile) ** 3
        return math.ceil((k - 1) / (2.0 * self._believed.kld_error) * cube)
