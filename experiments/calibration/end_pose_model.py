"""End poses of open-loop runs for given kr, kl, encoder gains and track."""

from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from sim.arrays import Array
from sim.compiled import njit
from sim.errors import require
from sim.robot.base import TICK_S
from sim.robot.drive import DifferentialDrive
from sim.robot.slip import SLIP_TIME_CONSTANT_S

Ticks = NDArray[np.int64]
EndPoseMethod = Literal["sampled", "linearised"]

_KNOTS = 24
_LOG_CHART_UP_TO_RAD = 4.5  # beyond it the logarithm nears its pole at 2 pi


class EndPoseModel:
    """End poses of one manoeuvre for candidate parameters.

    The run is cut at two dozen knots. Between two of them a wheel rolls as far as the command and
    the bias make it, less sqrt(k) times the slip's Brownian motion over the travel, delayed by the
    lag of the wheel's speed loop as in `sim.robot.slip.slip_increment`; the path is an arc.

    Parameters
    ----------
    profile
        (N, 2) commanded body velocities at ticks of 1/300 s, m/s and rad/s.
    nominal
        The robot that the commands were meant for.
    rng
        For the samples; unused by `linearised`.
    turn_rad
        Largest turn of the real robot, which decides the coordinates; None: the commanded one.
    """

    def __init__(
        self,
        profile: Array,
        nominal: DifferentialDrive,
        rng: np.random.Generator,
        method: EndPoseMethod,
        n_samples: int = 256,
        turn_rad: float | None = None,
    ) -> None:
        require(
            method in get_args(EndPoseMethod),
            f"method must be sampled or linearised, got {method!r}",
        )
        self._commands_m = nominal.wheel_speeds(*profile.T) * TICK_S
        self._knots = knots(self._commands_m)
        turn_rad = float(profile[:, 1].sum() * TICK_S) if turn_rad is None else turn_rad
        self._log_chart = abs(turn_rad) < _LOG_CHART_UP_TO_RAD
        self._linearised = method == "linearised"
        if not self._linearised:
            self._noise = _slip_paths(self._commands_m, self._knots, n_samples, rng)

    def coordinates(self, poses: Array) -> Array:
        """Coordinates (n, 3) of end poses (n, 3)."""
        return poses if self._linearised else _charted(poses, self._log_chart)

    def end_without_slip(self, bias: Array, track_m: float) -> Array:
        """End pose (3,) of a robot whose wheels only have their biases."""
        travel = _mean_travel(self._commands_m, self._knots, bias, TICK_S / SLIP_TIME_CONSTANT_S)
        return _linearised_moments(travel, np.zeros(2), track_m)[0]

    def moments(self, k: Array, bias: Array, track_m: float) -> tuple[Array, Array]:
        """Mean (3,) and covariance (3, 3) of the coordinates."""
        travel = _mean_travel(self._commands_m, self._knots, bias, TICK_S / SLIP_TIME_CONSTANT_S)
        if self._linearised:
            return _linearised_moments(travel, k * (1.0 + bias) ** -2.0, track_m)
        scale = np.sqrt(k) * (1.0 + bias) ** -1.5
        return _sampled_moments(travel, self._noise, scale, track_m, self._log_chart)


def knots(commands_m: Array) -> Ticks:
    """Ticks (S + 1,) that cut the run: evenly, and where the robot comes to rest between moves."""
    speed = np.abs(commands_m).max(axis=1)
    # a rounded plateau is not a turning point: a minimum must lie clearly below its surroundings
    change = np.diff(speed) / max(float(speed.max()), 1e-12)
    turning_points = np.flatnonzero((change[:-1] <= 0.0) & (change[1:] > 1e-6)) + 1
    even = np.linspace(0, len(commands_m), _KNOTS + 1).round().astype(np.int64)
    return np.unique(np.concatenate([even, turning_points]))


def _slip_paths(commands_m: Array, knots: Ticks, n_samples: int, rng: np.random.Generator) -> Array:
    """Slip (n, S, 2) of the ground travel between knots for k = 1, in m^(1/2).

    The encoder error of a tick, of variance |ds|, reaches the ground through the lag: by tick n,
    the share 1 - (1 - a)^(n - m) of the error of tick m. So the increments are normal with a known
    covariance. The samples come in antithetic pairs and are whitened: their first two moments are
    exact, and only the curvature of the arcs leaves a sampling error.
    """
    n_intervals = len(knots) - 1
    half = max(n_samples // 2, 2 * n_intervals + 2)
    z = rng.standard_normal((half, 2 * n_intervals))
    z = np.linalg.solve(np.linalg.cholesky(z.T @ z / half), z.T).T
    z = np.concatenate([z, -z]).reshape(2 * half, n_intervals, 2)
    age = np.maximum(knots[:, None] - 1 - np.arange(len(commands_m)), 0)  # (S + 1, N), ticks
    settled = 1.0 - (1.0 - TICK_S / SLIP_TIME_CONSTANT_S) ** age
    response = np.diff(settled, axis=0)  # (S, N): the share of each tick's error in each interval
    paths = np.empty_like(z)
    for i in (0, 1):
        values, vectors = np.linalg.eigh((response * np.abs(commands_m[:, i])) @ response.T)
        paths[:, :, i] = z[:, :, i] @ (vectors * np.sqrt(np.maximum(values, 0.0))).T
    return paths


@njit()
def _mean_travel(commands_m: Array, knots: Ticks, bias: Array, lag_share: float) -> Array:
    """Ground travel (S, 2) between knots without noise, through the lag of the slip law."""
    travel = np.zeros((len(knots) - 1, 2))
    for i in range(2):
        lag = 0.0
        for s in range(len(knots) - 1):
            for tick in range(knots[s], knots[s + 1]):
                rolling = commands_m[tick, i] - lag
                lag += lag_share * (bias[i] * rolling - lag)
                travel[s, i] += rolling
    return travel


@njit()
def _linearised_moments(travel: Array, k: Array, track_m: float) -> tuple[Array, Array]:
    """Pose (3,) and analytic covariance (3, 3) after wheel travels (S, 2) on the ground.

    puzzlebot2024, eq. (2), with the second form of eq. (6), its last row's sign settled. k is the
    variance of the ground travel a metre: that of the encoder, over (1 + bias)^2.
    """
    forward = (travel[:, 0] + travel[:, 1]) / 2.0
    half = (travel[:, 0] - travel[:, 1]) / (2.0 * track_m)
    heading = np.cumsum(2.0 * half)
    cos, sin = np.cos(heading - half), np.sin(heading - half)
    chord = forward * (1.0 - half**2 / 6.0 + half**4 / 120.0)
    x, y = np.cumsum(chord * cos), np.cumsum(chord * sin)
    covariance = np.zeros((3, 3))
    for w in range(2):
        turn = np.full(len(travel), (1.0 - 2.0 * w) / track_m)
        # a turn swings the interval itself, and the rest of the path about the interval's end
        by_x = cos / 2.0 - (forward * sin / 2.0 + y[-1] - y) * turn
        by_y = sin / 2.0 + (forward * cos / 2.0 + x[-1] - x) * turn
        by_wheel = np.stack((by_x, by_y, turn))
        covariance += (by_wheel * (k[w] * np.abs(travel[:, w]))) @ by_wheel.T
    return np.array([x[-1], y[-1], heading[-1]]), covariance


@njit()
def _charted(poses: Array, log_chart: bool) -> Array:
    """Coordinates (n, 3) in which end poses (n, 3) are nearly normal.

    The position is turned back by half the heading, which makes a blob of the crescent of a
    straight run. The logarithm also undoes the shortening of the chord, which makes it exact for
    a steady slip but gives it a pole at 2 pi.
    """
    charted = np.empty_like(poses)
    for n, (x, y, heading) in enumerate(poses):
        half = heading / 2.0
        cos, sin = np.cos(half), np.sin(half)
        stretch = half / sin if log_chart and abs(half) > 1e-4 else 1.0
        charted[n] = stretch * (cos * x + sin * y), stretch * (cos * y - sin * x), heading
    return charted


@njit(fastmath=True)
def _sampled_moments(
    travel: Array, noise: Array, scale: Array, track_m: float, log_chart: bool
) -> tuple[Array, Array]:
    """Mean (3,) and covariance (3, 3) of the coordinates of simulated end poses."""
    ends = np.empty((len(noise), 3))
    for n in range(len(noise)):
        x, y, heading = 0.0, 0.0, 0.0
        for s in range(len(travel)):
            right = travel[s, 0] - scale[0] * noise[n, s, 0]
            left = travel[s, 1] - scale[1] * noise[n, s, 1]
            half = (right - left) / (2.0 * track_m)
            chord = 0.5 * (right + left) * (1.0 - half**2 / 6.0 + half**4 / 120.0)
            x += chord * np.cos(heading + half)
            y += chord * np.sin(heading + half)
            heading += 2.0 * half
        ends[n] = x, y, heading
    charted = _charted(ends, log_chart)
    mean = charted.sum(axis=0) / len(noise)
    off = charted - mean
    return mean, off.T @ off / len(noise)
