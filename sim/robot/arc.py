"""Arc odometry: the pose after wheel increments, its Jacobian, and travel without encoder noise.

Wheel quantities come in pairs in the order (right, left), in metres along the ground.
"""

from collections import deque

import numpy as np

from sim.arrays import Array, ArrayLike

SMALL_ANGLE_RAD = 1e-4


def arc_increment(travel_m: ArrayLike, track_m: float) -> Array:
    """Relative pose (..., 3) after wheel increments (..., 2): the exact arc.

    Each wheel is taken to turn evenly over the interval. The heading is not wrapped.
    """
    travel = np.asarray(travel_m, float)
    forward = (travel[..., 0] + travel[..., 1]) / 2.0
    turn = (travel[..., 0] - travel[..., 1]) / track_m
    half = turn / 2.0
    small = np.abs(half) < SMALL_ANGLE_RAD
    chord = forward * np.where(small, 1.0 - half**2 / 6.0, np.sin(half) / np.where(small, 1, half))
    return np.stack([chord * np.cos(half), chord * np.sin(half), turn], axis=-1)


def arc_increment_jacobian(travel_m: ArrayLike, track_m: float) -> Array:
    """Derivative (..., 3, 2) of `arc_increment` by the increments of the right and left wheel.

    For small turns it is puzzlebot2024, eq. (6), second form, with the last row's sign settled:
    the right wheel turns the robot counter-clockwise, so it is (1/b, -1/b).
    """
    travel = np.asarray(travel_m, float)
    forward = (travel[..., 0] + travel[..., 1]) / 2.0
    half = (travel[..., 0] - travel[..., 1]) / track_m / 2.0
    small = np.abs(half) < SMALL_ANGLE_RAD
    safe = np.where(small, 1.0, half)
    sinc = np.where(small, 1.0 - half**2 / 6.0, np.sin(safe) / safe)
    sinc_slope = np.where(small, -half / 3.0, (np.cos(safe) - np.sin(safe) / safe) / safe)
    cos, sin = np.cos(half), np.sin(half)
    by_forward = np.stack([sinc * cos, sinc * sin, np.zeros_like(half)], axis=-1)
    by_half = np.stack(
        [
            forward * (sinc_slope * cos - sinc * sin),
            forward * (sinc_slope * sin + sinc * cos),
            np.full_like(half, 2.0),
        ],
        axis=-1,
    )
    right = by_forward / 2.0 + by_half / (2.0 * track_m)
    left = by_forward / 2.0 - by_half / (2.0 * track_m)
    return np.stack([right, left], axis=-1)


class TravelWindow:
    """Wheel travel |ds| of a frame, taken over a window so that encoder noise does not inflate it.

    |ds| of a short interval is mostly noise when the robot crawls, and a filter that adds k |ds|
    would overstate its variance. The net travel over at least `window_s` is shared out to the
    frame by its duration.

    Parameters
    ----------
    window_s
        Shortest time over which travel is netted, s.
    """

    def __init__(self, window_s: float = 0.05) -> None:
        self.window_s = window_s
        self._recent: deque[tuple[float, float, float]] = deque()

    def push(self, duration_s: float, travel_m: ArrayLike) -> Array:
        """Add a frame's duration and increments (2,); return its |ds| (2,), m."""
        right, left = (float(d) for d in np.asarray(travel_m, float))
        if duration_s <= 0.0:
            return np.abs([right, left])
        self._recent.append((duration_s, right, left))
        total_s = sum(entry[0] for entry in self._recent)
        while len(self._recent) > 1 and total_s - self._recent[0][0] >= self.window_s - 1e-9:
            total_s -= self._recent.popleft()[0]
        net_right = sum(entry[1] for entry in self._recent)
        net_left = sum(entry[2] for entry in self._recent)
        share = duration_s / total_s
        return np.array([abs(net_right) * share, abs(net_left) * share])
