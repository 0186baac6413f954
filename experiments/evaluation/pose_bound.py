"""The least covariance with which a path can be known: a posterior Cramer-Rao bound.

Tichavsky, Muravchik and Nehorai, "Posterior Cramer-Rao bounds for discrete-time nonlinear
filtering" (IEEE Transactions on Signal Processing, 1998), eq. (21), is a recursion of informations.
With Gaussian noise it is that of a Kalman filter linearised at the true path. It runs here on
covariances, because a known start and a robot at rest have no finite information. The smoothing
form, the bound on each pose given the whole recording, is that of Rauch, Tung and Striebel.

Landmarks that are not known are parameters with a flat prior. They are kept apart (Friedland,
"Treatment of bias in recursive filtering", 1969): beside the covariance P given the landmarks goes
the derivative U of the pose's estimate by them and the information S that all measurements carry
about them, so that the pose's own covariance is P + U S^-1 U^T. This is the Schur complement of
the joint information of path and landmarks, and never inverts the covariance of a motion.
"""

from typing import NamedTuple

import numpy as np
import scipy.linalg

from sim.arrays import Array, Ints

_GROUPS = 50  # times at most that S is factorised for the online bound
_RANK = 1e-13  # share of the greatest eigenvalue below which a covariance is singular


class Sights(NamedTuple):
    """Measurements of unknown landmarks, in the order of their Frames.

    Attributes
    ----------
    rows
        (K,) Frame of each.
    landmarks
        (K,) number of its landmark; they are numbered as they first appear.
    cross
        (K, 3, 3) information between the pose and the landmark, A^T R^-1 B.
    own
        (K, 3, 3) information about the landmark, B^T R^-1 B.
    """

    rows: Ints
    landmarks: Ints
    cross: Array
    own: Array


class Chain(NamedTuple):
    """A path and what is measured along it, linearised at the truth; poses are m, m, rad in map.

    Attributes
    ----------
    start
        (3, 3) covariance of the first pose before its measurements.
    by_before
        (T, 3, 3) derivative of each pose by the one before; the first is not read.
    noise
        (T, 3, 3) covariance of the motion to each pose; the first is not read.
    information
        (T, 3, 3) of the measurements at each pose about it, landmarks given.
    sights
        Those of unknown landmarks, or None.
    """

    start: Array
    by_before: Array
    noise: Array
    information: Array
    sights: Sights | None = None


class PathBound(NamedTuple):
    """Least covariances (T, 3, 3) of each pose: given the past, and given the whole recording."""

    online: Array
    revised: Array


def bound_path(chain: Chain) -> PathBound:
    """Bounds on the poses of a path.

    With more than 50 Frames that see unknown landmarks, the online bound knows the landmarks as
    they are known up to a fiftieth of the path later: it is a little lower, so still a bound.
    """
    predicted, online = _filter(chain)
    gains = np.zeros_like(online)
    crossed = online[:-1] @ chain.by_before[1:].transpose(0, 2, 1)
    gains[:-1] = crossed @ np.linalg.pinv(predicted[1:], rcond=_RANK, hermitian=True)
    revised = online.copy()
    for k in range(len(online) - 2, -1, -1):
        revised[k] += gains[k] @ (revised[k + 1] - predicted[k + 1]) @ gains[k].T
    if chain.sights is not None and len(chain.sights.rows):
        return _with_landmarks(chain, chain.sights, PathBound(online, revised), gains)
    return PathBound(online, revised)


def _filter(chain: Chain) -> tuple[Array, Array]:
    """Covariances (T, 3, 3) of each pose before its measurements and after, landmarks given."""
    predicted, updated = np.empty_like(chain.noise), np.empty_like(chain.noise)
    identity, P = np.eye(3), chain.start
    for k, (F, Q, information) in enumerate(
        zip(chain.by_before, chain.noise, chain.information, strict=True)
    ):
        P = F @ P @ F.T + Q if k else P
        predicted[k] = P
        if information.any():
            P = np.linalg.solve(identity + P @ information, P)
            P = (P + P.T) / 2.0
        updated[k] = P
    return predicted, updated


def _with_landmarks(chain: Chain, sights: Sights, given: PathBound, gains: Array) -> PathBound:
    """The bounds, from those given the landmarks and the gains of smoothing."""
    n_frames, n = len(chain.noise), 3 * (int(sights.landmarks.max()) + 1)
    cross = np.zeros((n_frames, 3, n))
    for row, landmark, block in zip(sights.rows, sights.landmarks, sights.cross, strict=True):
        cross[row, :, 3 * landmark : 3 * landmark + 3] += block
    U, V = np.zeros((n_frames, 3, n)), np.zeros((n_frames, 3, n))
    seeing = np.unique(sights.rows)
    sees = np.isin(np.arange(n_frames), seeing)
    for k in range(n_frames):
        if k:
            U[k] = chain.by_before[k] @ U[k - 1]
        V[k] = chain.information[k] @ U[k] + cross[k]
        if sees[k] or chain.information[k].any():
            U[k] -= given.online[k] @ V[k]
    online, revised = given.online.copy(), given.revised.copy()
    S, begin = np.zeros((n, n)), int(seeing[0])
    for end in _group_ends(seeing, n_frames):
        group = slice(begin, end)
        seen = slice(*np.searchsorted(sights.rows, [begin, end]))
        known = 3 * (int(sights.landmarks[: seen.stop].max()) + 1)
        part = S[:known, :known]
        _add_information(
            part,
            chain.information[group],
            given.online[group],
            U[group, :, :known],
            V[group, :, :known],
        )
        for landmark, own in zip(sights.landmarks[seen], sights.own[seen], strict=True):
            part[3 * landmark : 3 * landmark + 3, 3 * landmark : 3 * landmark + 3] += own
        online[group] += _spread(part, U[group, :, :known])
        begin = end
    for k in range(n_frames - 2, -1, -1):
        U[k] += gains[k] @ (U[k + 1] - chain.by_before[k + 1] @ U[k])
    return PathBound(online, revised + _spread(S, U))


def _group_ends(seeing: Ints, n_frames: int) -> list[int]:
    """Frames up to which, each excluded, the information about landmarks is read."""
    parts = np.array_split(seeing, min(len(seeing), _GROUPS))
    return [*(int(part[0]) for part in parts[1:]), n_frames]


def _add_information(S: Array, information: Array, updated: Array, U: Array, V: Array) -> None:
    """Add to S (n, n) what Frames tell of the landmarks, but for their own information."""
    # With the residual's derivative B + A U~ by the landmarks, U~ before the update, it is
    # (B + A U~)^T (R + A P~ A^T)^-1 (B + A U~); V is A^T R^-1 (B + A U~), so U~ = U + P V.
    n, gain = len(S), updated @ V
    before = U + gain
    outer = 2.0 * V - information @ before
    whole = before.reshape(-1, n).T @ outer.reshape(-1, n)
    whole -= V.reshape(-1, n).T @ gain.reshape(-1, n)
    S += (whole + whole.T) / 2.0


def _spread(S: Array, U: Array) -> Array:
    """U S^-1 U^T (T, 3, 3) of U (T, 3, n)."""
    root = scipy.linalg.cholesky(S, lower=True, check_finite=False)
    flat = np.ascontiguousarray(U.reshape(-1, len(S))).T
    half = scipy.linalg.solve_triangular(root, flat, lower=True, check_finite=False)
    rows = half.T.reshape(U.shape)
    return np.asarray(rows @ rows.transpose(0, 2, 1))
