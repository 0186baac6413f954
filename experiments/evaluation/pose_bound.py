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

import math
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
        (K, n, 3) information between the pose and the landmark, A^T R^-1 B.
    own
        (K, 3, 3) information about the landmark, B^T R^-1 B.
    """

    rows: Ints
    landmarks: Ints
    cross: Array
    own: Array


class Chain(NamedTuple):
    """A path and what is measured along it, linearised at the truth; poses are m, m, rad in map.

    Of R robots that know of each other, a pose is those of all, one after the other: n = 3 R.

    Attributes
    ----------
    start
        (n, n) covariance of the first pose before its measurements.
    by_before
        (T, n, n) derivative of each pose by the one before; the first is not read.
    noise
        (T, n, n) covariance of the motion to each pose; the first is not read.
    information
        (T, n, n) of the measurements at each pose about it, landmarks given.
    sights
        Those of unknown landmarks, or None.
    """

    start: Array
    by_before: Array
    noise: Array
    information: Array
    sights: Sights | None = None


class PathBound(NamedTuple):
    """Least covariances (T, n, n) of each pose: given the past, and given the whole recording."""

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


def bound_dead_reckoning(
    start: Array, steps: Array, by_wheels: Array, wheel_covariances: Array
) -> Array:
    """Least mean squares of poses by wheels alone, exactly: those of the conditional mean.

    Headings are a random walk, so the moments of positions as complex numbers have a closed form,
    and no error of a heading is too great for it. Heading errors are wrapped.

    Parameters
    ----------
    start
        (3, 3) covariance of the first pose; position and heading uncorrelated.
    steps
        (T, 3) motions that the encoders show; the first is not read.
    by_wheels
        (T, 3, 2) their derivatives by the wheels' travel.
    wheel_covariances
        (T, 2, 2) of the slip.

    Returns
    -------
    Array
        (T, 3, 3), diagonal; x and y share the error of the position.
    """
    heading = start[2, 2] + np.zeros(len(steps))
    # E|p - E p|^2, and E (p - E p) exp(-i heading): as differences of moments, they would cancel
    spread, to_robot = start[0, 0] + start[1, 1], 0j
    position = np.full(len(steps), spread)
    for k in range(1, len(steps)):
        (x, y, turn), W = steps[k], wheel_covariances[k]
        by_way, by_turn = by_wheels[k, 0] + 1j * by_wheels[k, 1], by_wheels[k, 2]
        way, turned = complex(x, y), by_turn @ W @ by_turn
        fanned = -math.expm1(-heading[k - 1])  # 1 - |E exp(i heading)|^2
        spread += 2.0 * (to_robot * way.conjugate()).real + fanned * abs(way) ** 2
        spread += (by_way @ W @ by_way.conj()).real
        to_robot = to_robot + fanned * way - 1j * (by_way @ W @ by_turn)
        to_robot *= np.exp(-1j * turn - turned / 2.0)
        position[k], heading[k] = spread, heading[k - 1] + turned
    n = np.arange(1, 40)[:, None]  # the Fourier series of the wrapped square
    wrapped = np.pi**2 / 3.0 + 4.0 * ((-1.0) ** n / n**2 * np.exp(-(n**2) * heading / 2.0)).sum(0)
    small = heading < 0.1
    diagonal = np.column_stack([position / 2.0, position / 2.0, np.where(small, heading, wrapped)])
    return np.asarray(diagonal[:, :, None] * np.eye(3))


def _filter(chain: Chain) -> tuple[Array, Array]:
    """Covariances (T, n, n) of each pose before its measurements and after, landmarks given."""
    predicted, updated = np.empty_like(chain.noise), np.empty_like(chain.noise)
    identity, P = np.eye(len(chain.start)), chain.start
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
    # Only Frames that measure something are kept (m of them); the others are reached from those.
    seeing = np.union1d(sights.rows, np.flatnonzero(chain.information.any(axis=(1, 2))))
    m, n, n_landmarks = len(seeing), len(chain.start), int(sights.landmarks.max()) + 1
    last = np.searchsorted(seeing, np.arange(len(chain.noise)), side="right")  # 0: none yet
    into, onward, back = _between(chain.by_before, gains, seeing)
    own_rows = np.searchsorted(seeing, sights.rows)
    V, U = np.zeros((m, n, n_landmarks, 3)), np.zeros((m, n, 3 * n_landmarks))
    np.add.at(V.transpose(0, 2, 1, 3), (own_rows, sights.landmarks), sights.cross)
    V = V.reshape(U.shape)
    information, updated = chain.information[seeing], given.online[seeing]
    for j in range(m):
        if j:
            U[j] = into[j] @ U[j - 1]
        V[j] += information[j] @ U[j]
        U[j] -= updated[j] @ V[j]
    S, spread = np.zeros((U.shape[2],) * 2), np.zeros((m + 1, n, n))
    for group in np.array_split(np.arange(m), min(m, _GROUPS)):
        rows = slice(group[0], group[-1] + 1)
        seen = slice(*np.searchsorted(own_rows, [rows.start, rows.stop]))
        known = 3 * (int(sights.landmarks[: seen.stop].max(initial=-1)) + 1)
        if not known:
            continue  # so far they tell nothing of a landmark
        part, of_known = S[:known, :known], U[rows, :, :known]
        _add_information(part, information[rows], updated[rows], of_known, V[rows, :, :known])
        for landmark, own in zip(sights.landmarks[seen], sights.own[seen], strict=True):
            part[3 * landmark : 3 * landmark + 3, 3 * landmark : 3 * landmark + 3] += own
        half = _solve_root(part, of_known)
        spread[1:][rows] = half @ half.transpose(0, 2, 1)
    online = given.online + onward @ spread[last] @ onward.transpose(0, 2, 1)
    smoothed = U.copy()
    for j in range(m - 2, -1, -1):
        smoothed[j] += back[seeing[j]] @ (smoothed[j + 1] - into[j + 1] @ U[j])
    # A Frame between two that are kept: filtered at the one before, smoothed at the one after
    none = np.zeros((1, n, U.shape[2]))
    ends = np.hstack(
        [_solve_root(S, np.vstack([none, U])), _solve_root(S, np.vstack([smoothed, none]))]
    )
    by_next = np.vstack([into, np.zeros((1, n, n))])[last]
    by_ends = np.concatenate([onward - back @ by_next, back], axis=2)
    joint = (ends @ ends.transpose(0, 2, 1))[last]
    return PathBound(online, given.revised + by_ends @ joint @ by_ends.transpose(0, 2, 1))


def _between(by_before: Array, gains: Array, seeing: Ints) -> tuple[Array, Array, Array]:
    """How Frames hang on those that are kept.

    Returns
    -------
    tuple of Array
        Derivative (m, n, n) of each kept pose by the one kept before; that of every pose (T, n, n)
        by the last kept one; and its gain (T, n, n) of smoothing from the next kept one.
    """
    kept = np.isin(np.arange(len(by_before)), seeing)
    into, onward, back = [], np.empty_like(by_before), gains.copy()
    reached = identity = np.eye(by_before.shape[1])
    for k, F in enumerate(by_before):
        reached = F @ reached if k else reached
        if kept[k]:
            into.append(reached)
            reached = identity
        onward[k] = reached
    for k in range(len(gains) - 2, -1, -1):
        if not kept[k + 1]:
            back[k] = gains[k] @ back[k + 1]
    return np.array(into), onward, back


def _add_information(S: Array, information: Array, updated: Array, U: Array, V: Array) -> None:
    """Add to S (n, n) what Frames tell of the landmarks, but for their own information."""
    # With the residual's derivative B + A U~ by the landmarks, U~ before the update, it is
    # (B + A U~)^T (R + A P~ A^T)^-1 (B + A U~); V is A^T R^-1 (B + A U~), so U~ = U + P V.
    flat, gain = (-1, len(S)), updated @ V
    before = U + gain
    outer = 2.0 * V - information @ before
    whole = before.reshape(flat).T @ outer.reshape(flat)
    whole -= V.reshape(flat).T @ gain.reshape(flat)
    S += (whole + whole.T) / 2.0


def _solve_root(S: Array, U: Array) -> Array:
    """U L^-T (m, n, s) of U (m, n, s), where S = L L^T."""
    root = scipy.linalg.cholesky(S, lower=True, check_finite=False)
    flat = np.ascontiguousarray(U.reshape(-1, len(S))).T
    half = scipy.linalg.solve_triangular(root, flat, lower=True, check_finite=False)
    return np.asarray(half.T.reshape(U.shape))
