"""Poses of key frames that a filter remembers, and which of them a scan should see again.

Between two changes of the key frame all measurements concern the few poses in use. What they teach
about the others is kept as a factor of their covariance, and applied once the others are needed
(the compressed filter of Guivant and Nebot, Optimization of the simultaneous localization and
map-building algorithm for real-time implementation, T-RA 17, 2001).
"""

import math

import numpy as np

from estimators.laser.icp_iterations import rotate
from estimators.laser.icp_judgement import find_beam_before
from estimators.laser.scan_lines import PreparedScan
from sim import se2
from sim.arrays import Array, Ints
from sim.compiled import njit

_EVERY = 4  # of a scan's points that are looked for
_NEAR_M = 0.3  # off the other scan's surface


class RememberedPoses:
    """Poses (3 K,) beside those in use (N,), and what is learnt of them; errors are twists in map.

    Parameters
    ----------
    n_used
        N, at the start of the state.
    mean, covariance, by_bias
        (N + 3 K,) of all, with the derivative (N + 3 K, 2) of their errors by the laser's biases;
        by default there are none but those in use.
    """

    def __init__(
        self,
        n_used: int,
        mean: Array | None = None,
        covariance: Array | None = None,
        by_bias: Array | None = None,
    ) -> None:
        if mean is None or covariance is None or by_bias is None:
            mean, covariance = np.zeros(n_used), np.zeros((n_used, n_used))
            by_bias = np.zeros((n_used, 2))
        self._by_bias = by_bias[n_used:]
        self._mean, self._covariance = mean[n_used:], covariance[n_used:, n_used:]
        self._cross = covariance[:n_used, n_used:]
        self.factor: Array | None = np.eye(n_used)  # of the cross-covariance; None once joined
        self._lost, self._moved = np.zeros((n_used, n_used)), np.zeros((n_used, 3))

    def select(self, rows: Ints) -> None:
        """Follow a choice of rows of the poses in use."""
        if self.factor is not None:
            self.factor = self.factor[rows]

    def learn(
        self, H: Array, first: slice, second: slice, S: Array, innovation: Array, gain: Array
    ) -> None:
        """Follow an update (D,) by two poses in use: derivative -H by the first, H by the second.

        S (D, D) is the covariance of the innovation, `gain` (N, D) that of the poses in use. The
        innovation (D, 3) has its derivative by the biases beside it.
        """
        if self.factor is None:
            return
        rows = H @ (self.factor[second] - self.factor[first])
        weighed = np.linalg.solve(S, rows).T
        self._lost += weighed @ rows
        self._moved += weighed @ innovation
        self.factor = self.factor - gain @ rows

    def join(self, mean: Array, covariance: Array, by_bias: Array) -> tuple[Array, Array, Array]:
        """The state of the poses in use with these poses after it, once."""
        if self.factor is None:
            return mean, covariance, by_bias
        cross, lost = self.factor @ self._cross, self._cross.T @ self._lost @ self._cross
        moved = self._cross.T @ self._moved
        twists = moved[:, 0].reshape(-1, 3)
        old = se2.compose(se2.exp(twists), self._mean.reshape(-1, 3)).ravel()
        self.factor = None
        own = self._covariance - (lost + lost.T) / 2.0
        joined = np.block([[covariance, cross], [cross.T, own]])
        return np.append(mean, old), joined, np.vstack([by_bias, self._by_bias - moved[:, 1:]])


@njit(error_model="numpy", fastmath={"contract"})
def seen_again(scan: PreparedScan, other: PreparedScan, pose: Array) -> float:
    """Share of a scan's points that lie near what the beams beside them saw in another scan.

    The pose is that of the scan in the other's frame.
    """
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    near, looked, j, rays = 0, 0, 0, other.rays
    for i in range(0, len(scan.points), _EVERY):
        x, y = rotate(cos, sin, scan.points[i, 0], scan.points[i, 1])
        x, y, looked = x + pose[0], y + pose[1], looked + 1
        j, between = find_beam_before(rays, other.full_circle, j, x, y)
        if not between:
            j = max(min(j, len(rays) - 2), 0)
            continue
        if rays[j, 0] * x + rays[j, 1] * y <= 0.0:
            continue
        off = math.hypot(x, y) - other.ranges_m[j]
        after = math.hypot(x, y) - other.ranges_m[j + 1 if j + 1 < len(rays) else 0]
        near += min(abs(off), abs(after)) < _NEAR_M
    return near / max(looked, 1)
