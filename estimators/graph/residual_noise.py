"""What wheels and registrations really err by, from how they disagree along the drive.

Wheels are compared with registrations from key frame to key frame, and a registration over two key
frames with the two that it spans. The mean error of the wheels, a turn by the way and by the turn
and a stretch of the way, is taken off. What is believed of their noise is widened where they
disagree by more; it is never narrowed. Differences count up to five times their median, so that a
slip or a wrong registration does not widen all others.
"""

import collections

import numpy as np

from estimators.gaussian import Gaussian
from sim import se2
from sim.arrays import Array

_REMEMBERED = 200  # comparisons
_MOST = 1e4
_LIMIT = 25.0  # of squares, in medians
_MOST_OF_SCANS = 400.0
_GAIN_SIGMA = 0.1  # of the wheels' mean errors, before any is seen; rad/m, and shares


class ResidualNoise:
    """Scales of the covariances of wheels and registrations, from what was compared so far.

    Attributes
    ----------
    of_wheels
        (3,) of the variances of a motion by wheels, along, across and of the turn; 1 or more.
    of_wheels_alone
        (3,) as `of_wheels`, with all slips: where wheels are all there is.
    of_scans
        Of the covariance of a registration; 1 or more.
    """

    def __init__(self) -> None:
        self.of_wheels, self.of_wheels_alone, self.of_scans = np.ones(3), np.ones(3), 1.0
        self._gains = np.zeros((3, 2))  # mean error of x, y and the turn, by the way and the turn
        self._wheels: collections.deque[Array] = collections.deque(maxlen=_REMEMBERED)
        self._scans: collections.deque[float] = collections.deque(maxlen=_REMEMBERED)

    def corrected(self, motion: Gaussian, *, alone: bool = False) -> Gaussian:
        """A motion by wheels without their mean error, with the noise they show, or at worst."""
        root = np.sqrt(self.of_wheels_alone if alone else self.of_wheels)
        mean = motion.mean + self._gains @ motion.mean[[0, 2]]
        return Gaussian(mean, motion.covariance * np.outer(root, root))

    def compare_wheels(self, by_wheels: Gaussian, registered: Gaussian) -> None:
        """Take in a motion by wheels, as logged, and as registered."""
        off = se2.difference(registered.mean, by_wheels.mean)
        believed = np.diag(by_wheels.covariance), np.diag(registered.covariance)
        self._wheels.append(np.array([off, registered.mean, *believed]))
        off, motions, own, others = np.array(self._wheels).transpose(1, 0, 2)
        by = motions[:, [0, 2]]
        own, others = np.maximum(own.mean(axis=0), 1e-12), others.mean(axis=0)
        for k in (0, 2):  # across, wheels tell nothing
            error = off[:, k]
            limit = 5.0 * np.median(np.abs(error)) + 1e-9
            spread = float(np.mean(np.clip(error, -limit, limit) ** 2))
            prior = (spread / _GAIN_SIGMA**2) * np.eye(2)
            self._gains[k] = np.linalg.solve(
                by.T @ by + prior, by.T @ np.clip(error, -limit, limit)
            )
        squared = (off - by @ self._gains.T) ** 2
        kept = np.minimum(squared, _LIMIT * np.median(squared, axis=0))
        scales = (np.array([kept, squared]).mean(axis=1) - others) / own
        self.of_wheels, self.of_wheels_alone = np.clip(scales, 1.0, _MOST)

    def compare_scans(self, direct: Gaussian, first: Gaussian, second: Gaussian) -> None:
        """Take in a registration, and the two that lead the same way, as believed at first."""
        around = first.then(second)
        off = se2.difference(direct.mean, around.mean)
        spread = direct.covariance + around.covariance
        self._scans.append(float(off @ np.linalg.solve(spread, off)))
        squared = np.array(self._scans)
        kept = np.minimum(squared, _LIMIT * max(float(np.median(squared)), 0.1))
        self.of_scans = float(np.clip(kept.mean() / 3.0, 1.0, _MOST_OF_SCANS))
