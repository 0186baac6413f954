"""One Gaussian over poses and landmarks with all their correlations, as a filter keeps it."""

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from sim.arrays import Array, Ints


class JointGaussian:
    """Mean (N,) and covariance (N, N), which lies in a room allotted for more.

    Parameters
    ----------
    mean, covariance
        Of what is known at the start; they are taken over.
    most
        Largest N that room is allotted for.
    """

    def __init__(self, mean: Array, covariance: Array, most: int | None = None) -> None:
        self.mean, self._room, self._most = mean, covariance, most

    @property
    def covariance(self) -> Array:
        """(N, N), the part of the room that is in use."""
        n = len(self.mean)
        return self._room[:n, :n]

    def predicted(
        self, own: slice, at: Ints, of_pose: Array, of_other: Array
    ) -> tuple[Array, Array, Array]:
        """H P (3 K, N) of K observations, and H P H^T (3 K, 3 K) in two parts, of either block.

        Parameters
        ----------
        own, at
            Rows of the observing pose, and (K, 3) of what it observes.
        of_pose, of_other
            (K, 3, 3) derivatives of the observations by these: H has two blocks a row.
        """
        P, K, n = self.covariance, len(at), 3 * len(at)
        HP = (of_pose @ P[own] + of_other @ P[at]).reshape(n, -1)
        along = HP[:, at].reshape(n, K, 3).transpose(1, 0, 2)
        by_other = (along @ of_other.transpose(0, 2, 1)).transpose(1, 0, 2).reshape(n, n)
        return HP, HP[:, own] @ of_pose.reshape(n, 3).T, by_other

    def update(self, HP: Array, S: Array, innovations: Array) -> Array | None:
        """Kalman update of the covariance; the correction (N,) that the mean is due.

        None, and nothing is changed, if rounding has left S, the innovations' covariance, without
        being positive definite.
        """
        try:
            factor = cho_factor((S + S.T) / 2.0, lower=True)
        except np.linalg.LinAlgError:
            return None
        correction: Array = HP.T @ cho_solve(factor, innovations.ravel())
        half = solve_triangular(factor[0], HP, lower=True)
        P = self.covariance
        P -= half.T @ half  # symmetric to the last bit
        return correction

    def extend(self, own: slice, by_pose: Array, points: Array, noise: Array) -> None:
        """Append landmarks at points (K, 3), gil2008, eqs. (16)-(18), with their correlations.

        Parameters
        ----------
        own
            Rows of the pose that they were seen from.
        by_pose
            (K, 3, 3) derivatives of the points by it.
        noise
            (K, 3, 3) what their measurement adds to their covariance.
        """
        before, n = len(self.mean), 3 * len(points)
        after, J = before + n, by_pose.reshape(n, 3)
        if after > len(self._room):
            wanted = after + after // 2
            wanted = wanted if self._most is None else min(wanted, self._most)
            self._room = np.pad(self.covariance, (0, wanted - before))
        P = self._room[:after, :after]
        P[before:, :before] = J @ P[own, :before]
        P[:before, before:] = P[before:, :before].T
        fresh = J @ P[own, own] @ J.T
        for k, block in enumerate(noise):
            fresh[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += block
        P[before:, before:] = (fresh + fresh.T) / 2.0
        self.mean = np.concatenate([self.mean, points.ravel()])

    def keep(self, kept: Array) -> None:
        """Drop all but these rows (N,)."""
        self._room = self.covariance[np.ix_(kept, kept)]
        self.mean = self.mean[kept]


def quarter_turned(points: Array) -> Array:
    """Points (..., 2) turned by a quarter about the map's origin: d(R(a) x) / da at 0."""
    return np.stack([-points[..., 1], points[..., 0]], axis=-1)


def mahalanobis_squared(v: Array, S: Array) -> Array:
    """Squared distances (...) of innovations v (..., 3) by their covariances S (..., 3, 3)."""
    return np.asarray(np.sum(v * np.linalg.solve(S, v[..., None])[..., 0], axis=-1))
