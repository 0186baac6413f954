"""Planar rigid motions: poses are arrays (..., 3) of x (m), y (m), heading (rad).

Frames: `T_a_b` is the pose of frame b in frame a, so `compose(T_a_b, T_b_c)` is `T_a_c`.
All functions broadcast over leading axes.
"""

import numpy as np

from sim.arrays import Array, ArrayLike

_SMALL_ANGLE_RAD = 1e-4  # below it the series are exact to the last bit


def wrap(angle_rad: ArrayLike) -> Array:
    """Bring angles into (-pi, pi].

    >>> float(wrap(3 * np.pi)) == np.pi
    True
    """
    wrapped = np.mod(np.asarray(angle_rad, dtype=np.float64) + np.pi, 2.0 * np.pi) - np.pi
    return np.where(wrapped == -np.pi, np.pi, wrapped)


def compose(T_a_b: ArrayLike, T_b_c: ArrayLike) -> Array:
    """Pose of c in a, shape (..., 3); the heading is wrapped."""
    first, second = np.asarray(T_a_b, dtype=np.float64), np.asarray(T_b_c, dtype=np.float64)
    cos, sin = np.cos(first[..., 2]), np.sin(first[..., 2])
    x = first[..., 0] + cos * second[..., 0] - sin * second[..., 1]
    y = first[..., 1] + sin * second[..., 0] + cos * second[..., 1]
    return np.stack([x, y, wrap(first[..., 2] + second[..., 2])], axis=-1)


def inverse(T_a_b: ArrayLike) -> Array:
    """Pose of a in b, shape (..., 3)."""
    pose = np.asarray(T_a_b, dtype=np.float64)
    cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    x = -cos * pose[..., 0] - sin * pose[..., 1]
    y = sin * pose[..., 0] - cos * pose[..., 1]
    return np.stack([x, y, wrap(-pose[..., 2])], axis=-1)


def between(T_w_a: ArrayLike, T_w_b: ArrayLike) -> Array:
    """Pose of b in a, shape (..., 3): what takes a to b."""
    return compose(inverse(T_w_a), T_w_b)


def difference(first: Array, second: Array) -> Array:
    """First less second, number by number, (..., 3); the heading is wrapped."""
    off = first - second
    off[..., 2] = wrap(off[..., 2])
    return off


def transform(T_a_b: ArrayLike, points_in_b: ArrayLike) -> Array:
    """Points (..., N, 2) of frame b, m, in frame a."""
    pose, points = np.asarray(T_a_b, dtype=np.float64), np.asarray(points_in_b, dtype=np.float64)
    cos, sin = np.cos(pose[..., 2, None]), np.sin(pose[..., 2, None])
    x = pose[..., 0, None] + cos * points[..., 0] - sin * points[..., 1]
    y = pose[..., 1, None] + sin * points[..., 0] + cos * points[..., 1]
    return np.stack([x, y], axis=-1)


def chain(increments: ArrayLike, start: ArrayLike = (0.0, 0.0, 0.0)) -> Array:
    """Poses (N + 1, 3) from relative poses (N, 3) and a start pose; headings unwrapped."""
    steps, first = np.asarray(increments, float), np.asarray(start, float)
    heading = first[2] + np.concatenate([[0.0], np.cumsum(steps[:, 2])])
    cos, sin = np.cos(heading[:-1]), np.sin(heading[:-1])
    moves = np.stack([cos * steps[:, 0] - sin * steps[:, 1], sin * steps[:, 0] + cos * steps[:, 1]])
    positions = np.concatenate([np.zeros((1, 2)), np.cumsum(moves.T, axis=0)])
    return np.column_stack([first[:2] + positions, heading])


def compose_jacobians(T_a_b: ArrayLike, T_b_c: ArrayLike) -> tuple[Array, Array]:
    """Derivatives (..., 3, 3) of `compose` by its first and second argument."""
    first, second = np.asarray(T_a_b, dtype=np.float64), np.asarray(T_b_c, dtype=np.float64)
    cos, sin = np.cos(first[..., 2]), np.sin(first[..., 2])
    shape = (*np.broadcast_shapes(first.shape[:-1], second.shape[:-1]), 3, 3)
    by_first = np.zeros(shape)
    by_first[..., 0, 0] = by_first[..., 1, 1] = by_first[..., 2, 2] = 1.0
    by_first[..., 0, 2] = -sin * second[..., 0] - cos * second[..., 1]
    by_first[..., 1, 2] = cos * second[..., 0] - sin * second[..., 1]
    by_second = np.zeros(shape)
    by_second[..., 0, 0] = by_second[..., 1, 1] = cos
    by_second[..., 0, 1], by_second[..., 1, 0] = -sin, sin
    by_second[..., 2, 2] = 1.0
    return by_first, by_second


def between_jacobians(T_w_a: ArrayLike, T_w_b: ArrayLike) -> tuple[Array, Array]:
    """Derivatives (..., 3, 3) of `between` by its first and second argument."""
    first, second = np.asarray(T_w_a, dtype=np.float64), np.asarray(T_w_b, dtype=np.float64)
    cos, sin = np.cos(first[..., 2]), np.sin(first[..., 2])
    relative = between(first, second)
    by_second = np.zeros((*relative.shape[:-1], 3, 3))
    by_second[..., 0, 0] = by_second[..., 1, 1] = cos
    by_second[..., 0, 1], by_second[..., 1, 0] = sin, -sin
    by_second[..., 2, 2] = 1.0
    by_first = -by_second
    by_first[..., 0, 2] = relative[..., 1]
    by_first[..., 1, 2] = -relative[..., 0]
    return by_first, by_second


def exp(twist: ArrayLike) -> Array:
    """Pose reached by a constant twist (..., 3) of (m, m, rad) in one unit of time.

    The heading is wrapped; the arc is exact for any angle.
    """
    tangent = np.asarray(twist, dtype=np.float64)
    angle = tangent[..., 2]
    small = np.abs(angle) < _SMALL_ANGLE_RAD
    safe = np.where(small, 1.0, angle)
    sinc = np.where(small, 1.0 - angle**2 / 6.0, np.sin(safe) / safe)
    cosc = np.where(small, angle / 2.0 - angle**3 / 24.0, 2.0 * np.sin(safe / 2.0) ** 2 / safe)
    x = sinc * tangent[..., 0] - cosc * tangent[..., 1]
    y = cosc * tangent[..., 0] + sinc * tangent[..., 1]
    return np.stack([x, y, wrap(angle)], axis=-1)


def log(pose: ArrayLike) -> Array:
    """Twist (..., 3) whose `exp` is the pose.

    The heading is taken as it stands, so an unwrapped one gives the twist of the longer way
    round; it must not be a non-zero multiple of 2 pi.
    """
    p = np.asarray(pose, dtype=np.float64)
    half = p[..., 2] / 2.0
    small = np.abs(half) < _SMALL_ANGLE_RAD
    safe = np.where(small, 1.0, half)
    stretch = np.where(small, 1.0 - half**2 / 3.0, safe / np.tan(safe))
    x = stretch * p[..., 0] + half * p[..., 1]
    y = -half * p[..., 0] + stretch * p[..., 1]
    return np.stack([x, y, p[..., 2]], axis=-1)
