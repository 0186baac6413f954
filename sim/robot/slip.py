"""The slip law: how encoder readings differ from the wheels' travel on the ground.

`kr` and `kl` are variances per metre: Var(encoder - ground) = k |ds| (puzzlebot2024, eq. (5);
decristoforis2020, eq. (2)), so their unit is the metre. The simulator, the batches of
`sim.robot.kinematic`, and estimators' beliefs take the law from here.
"""

import math
from collections.abc import Iterator
from typing import Protocol

import numpy as np

from sim.arrays import Array, ArrayLike
from sim.errors import require
from sim.options import NonNegative, options
from sim.robot.arc import TravelWindow

SLIP_TIME_CONSTANT_S = 0.1
_EVENT_TICKS = 30
_MIN_BIAS, _MAX_BIAS = -0.67, 2.0  # the encoder reads between a third and three times the travel
_Wheels = tuple[float, float]  # right and left


class SlipLaw(Protocol):
    """The slip of a robot's wheels at work, tick by tick."""

    @property
    def correction_mps(self) -> _Wheels:
        """Speeds to take off the commands of the right and left wheel at the next tick, m/s."""

    def advance(self, rolling_m: _Wheels) -> _Wheels:
        """Encoder increments, m, of a tick in which the wheels rolled so far on the ground."""


@options("robot")
class SlipOptions:
    """How the wheels of a robot slip: the truth, never an estimator's belief."""

    kr: NonNegative = 0.0
    """Slip variance per metre of the right wheel, m."""
    kl: NonNegative = 0.0
    """Slip variance per metre of the left wheel, m."""
    bias_right: float = 0.0
    """Systematic slip: the right encoder reads (1 + bias) times the ground travel, a factor of
    three either way at most. The wheel's loop settles within 0.1 s / (1 + bias)."""
    bias_left: float = 0.0
    """As `bias_right`, of the left wheel."""
    unmodelled_slip: NonNegative = 0.0
    """Stress: events per second and wheel in which the wheel does not grip, and its encoder runs
    on while the ground travel stands. kr and kl do not describe them."""
    unmodelled_slip_m: NonNegative = 0.02
    """Encoder travel of one such event, m."""
    forward_slip_m: NonNegative = 0.0
    """Variance per metre of the slip that both wheels share, m: both encoders err alike."""
    forward_slip_length_m: NonNegative = 0.0
    """Travel over which slip of both wheels together is forgotten, m; 0: at once."""

    def __post_init__(self) -> None:
        for name in ("bias_right", "bias_left"):
            value = getattr(self, name)
            require(
                _MIN_BIAS <= value <= _MAX_BIAS,
                f"robot.{name} must lie in [{_MIN_BIAS:g}, {_MAX_BIAS:g}], a factor of "
                f"three either way, got {value}",
            )
        require(
            not self.forward_slip_length_m or self.forward_slip_m,
            "robot.forward_slip_length_m has no effect without such slip; set robot.forward_slip_m",
        )

    @property
    def slip_variance_per_m(self) -> Array:
        """(kr, kl), m."""
        return np.array([self.kr, self.kl])

    @property
    def slip_bias(self) -> Array:
        """(bias_right, bias_left)."""
        return np.array([self.bias_right, self.bias_left])

    def start_slip(self, dt_s: float, rng: np.random.Generator) -> SlipLaw:
        """Slip at work of a robot at rest, at ticks of `dt_s`."""
        return WheelSlip(self, dt_s, rng)


def slip_increment(
    rolling_m: float, lag_m: float, law: _Wheels, normal: float, extra_m: float, lag_share: float
) -> tuple[float, float]:
    """Encoder increment of one wheel in one tick, and the state of its lag then, m.

    At each tick the wheel is driven at its command less lag / tick; it rolls `rolling_m` on the
    ground and its encoder reads that plus an error of variance k |rolling|, white over ticks.
    The error flows back into the drive through a first-order lag, because the wheel's speed
    loop is closed on the encoder: over times beyond the lag the encoder follows the command and
    the ground travel wanders.

    Parameters
    ----------
    law
        k, m, and the share by which the encoder reads more than the wheel rolls.
    normal
        A standard normal.
    extra_m
        An encoder error from outside k.
    lag_share
        Length of a tick over `SLIP_TIME_CONSTANT_S`.
    """
    variance_per_m, bias = law
    error = bias * rolling_m + extra_m
    error += math.sqrt(variance_per_m * abs(rolling_m)) * normal
    return rolling_m + error, lag_m + lag_share * (error - lag_m)


def forward_increment(
    travel_m: float, share: float, variance_per_m: float, length_m: float, normal: float
) -> tuple[float, float]:
    """Error of both encoders, m, in one tick, and the lasting share of the travel then.

    Slip that both wheels share is white over the way, or a share of the travel that lasts: an
    Ornstein-Uhlenbeck process of length l over the travel s, with the variance q / 2l. So its
    error over s has the variance q (s - l (1 - exp(-s / l))): q per metre in the long run.
    """
    if length_m == 0.0:
        return math.sqrt(variance_per_m * travel_m) * normal, 0.0
    kept = math.exp(-travel_m / length_m)
    spread = math.sqrt(variance_per_m / (2.0 * length_m))
    share = kept * share + spread * math.sqrt(1.0 - kept * kept) * normal
    return share * travel_m, share


class WheelSlip:
    """The slip of both wheels: of each by kr, kl and its bias, of both together, and events."""

    def __init__(self, slip: SlipOptions, dt_s: float, rng: np.random.Generator) -> None:
        self._dt_s, self._lag_share = dt_s, dt_s / SLIP_TIME_CONSTANT_S
        self._right, self._left = (slip.kr, slip.bias_right), (slip.kl, slip.bias_left)
        self._lag_m = 0.0, 0.0
        self._normals = _normals(rng)
        self._events = _SlipEvents(slip, dt_s, rng)
        self._q_m, self._length_m = slip.forward_slip_m, slip.forward_slip_length_m
        self._forward = _normals(rng.spawn(1)[0])
        self._share = 0.0
        if self._length_m:
            self._share = math.sqrt(self._q_m / (2.0 * self._length_m)) * next(self._forward)[0]

    @property
    def correction_mps(self) -> _Wheels:
        """Speeds to take off the commands of the right and left wheel at the next tick, m/s."""
        right_m, left_m = self._lag_m
        return right_m / self._dt_s, left_m / self._dt_s

    def advance(self, rolling_m: _Wheels) -> _Wheels:
        """Encoder increments, m, of a tick in which the wheels rolled so far on the ground."""
        right_m, left_m = rolling_m
        z_right, z_left = next(self._normals)
        extra_right, extra_left = self._events.error(rolling_m)
        both = 0.0
        if self._q_m:
            travel_m, normal = (abs(right_m) + abs(left_m)) / 2.0, next(self._forward)[0]
            both, self._share = forward_increment(
                travel_m, self._share, self._q_m, self._length_m, normal
            )
        lag_right, lag_left = self._lag_m
        right, lag_right = slip_increment(
            right_m, lag_right, self._right, z_right, extra_right + both, self._lag_share
        )
        left, lag_left = slip_increment(
            left_m, lag_left, self._left, z_left, extra_left + both, self._lag_share
        )
        self._lag_m = lag_right, lag_left
        return right, left


class _SlipEvents:
    """Slip that kr and kl do not describe: a wheel's encoder runs on by some centimetres."""

    def __init__(self, slip: SlipOptions, dt_s: float, rng: np.random.Generator) -> None:
        self._chance = slip.unmodelled_slip * dt_s
        self._step_m = slip.unmodelled_slip_m / _EVENT_TICKS
        self._rng = rng.spawn(1)[0]
        self._left = np.zeros(2, dtype=np.int64)

    def error(self, rolling_m: _Wheels) -> _Wheels:
        """Encoder errors of the right and left wheel, m, of this tick."""
        if self._chance == 0.0:
            return 0.0, 0.0
        self._left[self._rng.random(2) < self._chance] = _EVENT_TICKS
        active = self._left > 0
        self._left[active] -= 1
        right, left = np.where(active, self._step_m * np.sign(rolling_m), 0.0).tolist()
        return right, left


def _normals(rng: np.random.Generator, block: int = 3000) -> Iterator[_Wheels]:
    """Pairs of standard normals, drawn in blocks for speed; the bits do not depend on the block."""
    while True:
        yield from rng.standard_normal((block, 2)).tolist()


def wheel_variances(travel_m: ArrayLike, kr: float, kl: float) -> Array:
    """Variances (..., 2) m^2 of wheel increments (..., 2): k |ds| (puzzlebot2024, eq. (5))."""
    return np.asarray(np.abs(np.asarray(travel_m, float)) * np.array([kr, kl]))


def wheel_errors(travel_m: ArrayLike, variance_per_m: ArrayLike, rng: np.random.Generator) -> Array:
    """Zero-mean encoder errors, m, of variance k |ds|: the law of `slip_increment` without its lag.

    Parameters
    ----------
    travel_m
        Wheel increments (..., 2), m, or of any other shape.
    variance_per_m
        k, m: one value, or (kr, kl).
    rng
        Gives one standard normal for each increment.

    Returns
    -------
    Array
        Errors of the shape of `travel_m`.
    """
    travel = np.asarray(travel_m, float)
    spread = np.sqrt(np.asarray(variance_per_m, float) * np.abs(travel))
    return np.asarray(spread * rng.standard_normal(travel.shape))


def twist_covariances(
    duration_s: ArrayLike, travel_m: ArrayLike, track_m: float, kr: float, kl: float
) -> Array:
    """Covariances (T, 3, 3) of mean velocities in base_link, by the wheels' slip.

    v = (ds_r + ds_l) / (2 dt) and omega = (ds_r - ds_l) / (b dt) have the covariance
    J diag(kr |ds_r|, kl |ds_l|) J^T / dt^2 (puzzlebot2024, eqs. (5)-(6)). Wheels do not err
    sideways. |ds| is that of a `TravelWindow`.

    Parameters
    ----------
    duration_s
        (T,) of the intervals, s. One without a duration has no velocity, and zeros here.
    travel_m
        Wheel increments (T, 2) over them, m.

    Returns
    -------
    Array
        In the order vx, vy, omega; m^2/s^2, rad^2/s^2.
    """
    durations, travel = np.asarray(duration_s, float), np.asarray(travel_m, float)
    window = TravelWindow()
    netted = [window.push(lapse, ds) for lapse, ds in zip(durations, travel, strict=True)]
    variances = wheel_variances(np.reshape(netted, (-1, 2)), kr, kl)
    by_wheels = np.array([[0.5, 0.5], [0.0, 0.0], [1.0 / track_m, -1.0 / track_m]])
    per_s = np.divide(1.0, durations, out=np.zeros_like(durations), where=durations > 0.0)
    return np.asarray(np.einsum("ij,tj,kj,t->tik", by_wheels, variances, by_wheels, per_s**2))
