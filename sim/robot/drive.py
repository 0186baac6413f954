"""The differential-drive robot: geometry, the kr/kl slip law, arc odometry and its Jacobians.

Wheel quantities come in pairs in the order (right, left), in metres along the ground.
`kr` and `kl` are variances per metre: Var(encoder - ground) = k |ds| (puzzlebot2024, eq. (5);
decristoforis2020, eq. (2)), so their unit is the metre.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sim.arrays import Array
from sim.errors import require
from sim.settings import check_numbers

SLIP_TIME_CONSTANT_S = 0.1
SMALL_ANGLE_RAD = 1e-4
_LEAST_BIAS, _MOST_BIAS = -0.67, 2.0  # the encoder reads between a third and three times the travel


@dataclass(frozen=True)
class DifferentialDrive:
    """What the simulated robot is and how its wheels slip: the truth, never an estimator's belief.

    The nominal geometry is part of that truth: it is what the robot's own controller uses, right
    or wrong.

    Parameters
    ----------
    wheel_radius_m, track_m
        Wheel radius and distance between the wheels' contact points.
    kr, kl
        Slip variance per metre of the right and left wheel, m.
    bias_right, bias_left
        Systematic part of the slip: the encoder reads (1 + bias) times the ground travel. A factor
        of three either way is the most. The wheel's loop settles within 0.1 s / (1 + bias).
    nominal_wheel_radius_m, nominal_track_m
        Geometry by which the robot's controller turns body velocities into wheel speeds and wheel
        angles into metres; None for the true one. A robot whose nominal track is 0.44 of the true
        one turns by 0.44 of what it is commanded.
    encoder_tick_m
        Quantum of the encoder counts, in metres that the encoder reports; 0 for no quantisation.
    encoder_pulses_per_turn
        Pulses per turn of the encoder's shaft, in place of `encoder_tick_m`; 0 for none.
    gear_ratio
        Turns of the encoder's shaft for one turn of the wheel.
    unmodelled_slip
        Stress: probability per second of an event that stops a wheel from gripping (its
        encoder runs on by `unmodelled_slip_m` while the ground travel stands). It is not
        described by kr, kl and is 0 unless asked for.
    unmodelled_slip_m
        Encoder travel of one such event, m.
    forward_slip_m
        Variance per metre of what both wheels slip together, m: their encoders gain the same error.
    forward_slip_length_m
        Travel over which slip of both wheels together is forgotten, m; 0: at once.
    body_length_m, body_width_m, body_height_m, mass_kg
        The body, centred over the axle.
    max_acceleration_mps2
        Limit of each wheel's acceleration along the ground.
    """

    wheel_radius_m: float
    track_m: float
    kr: float = 0.0
    kl: float = 0.0
    bias_right: float = 0.0
    bias_left: float = 0.0
    nominal_wheel_radius_m: float | None = None
    nominal_track_m: float | None = None
    encoder_tick_m: float = 0.0
    encoder_pulses_per_turn: int = 0
    gear_ratio: float = 1.0
    unmodelled_slip: float = 0.0
    unmodelled_slip_m: float = 0.02
    forward_slip_m: float = 0.0
    forward_slip_length_m: float = 0.0
    body_length_m: float = 0.18
    body_width_m: float = 0.14
    body_height_m: float = 0.10
    mass_kg: float = 1.3
    max_acceleration_mps2: float = 1.0

    def __post_init__(self) -> None:
        check_numbers(
            "robot",
            self,
            (
                "wheel_radius_m",
                "track_m",
                "body_length_m",
                "body_width_m",
                "body_height_m",
                "mass_kg",
                "max_acceleration_mps2",
                "gear_ratio",
            ),
            (
                "kr",
                "kl",
                "encoder_tick_m",
                "encoder_pulses_per_turn",
                "unmodelled_slip",
                "unmodelled_slip_m",
                "forward_slip_m",
                "forward_slip_length_m",
            ),
        )
        for name in ("nominal_wheel_radius_m", "nominal_track_m"):
            if getattr(self, name) is not None:
                check_numbers("robot", self, (name,))
                ratio = getattr(self, name) / getattr(self, name.removeprefix("nominal_"))
                require(
                    0.1 <= ratio <= 10.0,
                    f"robot.{name} must lie within a factor of ten of the true one, "
                    f"got {ratio:.3g} times it",
                )
        for name in ("bias_right", "bias_left"):
            value = getattr(self, name)
            require(
                _LEAST_BIAS <= value <= _MOST_BIAS,
                f"robot.{name} must lie in [{_LEAST_BIAS:g}, {_MOST_BIAS:g}], a factor of "
                f"three either way, got {value}",
            )
        require(
            not self.encoder_pulses_per_turn or not self.encoder_tick_m,
            "robot.encoder_pulses_per_turn and robot.encoder_tick_m both set the encoder's "
            "quantum; set one of them to 0",
        )
        require(
            not self.forward_slip_length_m or self.forward_slip_m,
            "robot.forward_slip_length_m has no effect without such slip; set robot.forward_slip_m",
        )
        require(
            self.gear_ratio == 1.0 or self.encoder_pulses_per_turn,
            "robot.gear_ratio has no effect without pulses; set robot.encoder_pulses_per_turn, "
            "or robot.gear_ratio=1",
        )

    @property
    def slip_variance_per_m(self) -> Array:
        """(kr, kl), m."""
        return np.array([self.kr, self.kl])

    @property
    def slip_bias(self) -> Array:
        """(bias_right, bias_left)."""
        return np.array([self.bias_right, self.bias_left])

    @cached_property
    def nominal(self) -> RobotGeometry:
        """The geometry that the robot's controller uses, and that its recordings state."""
        return RobotGeometry(
            self.nominal_wheel_radius_m or self.wheel_radius_m, self.nominal_track_m or self.track_m
        )

    @property
    def encoder_quantum_m(self) -> float:
        """Travel of one encoder count in metres that the encoder reports; 0 for none.

        2 pi r / (pulses per turn * gear ratio), with the nominal radius r (decristoforis2020, the
        distances rolled in eq. (1); their formula is lost in the text that we have, its symbols
        are explained).
        """
        if not self.encoder_pulses_per_turn:
            return self.encoder_tick_m
        pulses = self.encoder_pulses_per_turn * self.gear_ratio
        return 2.0 * math.pi * self.nominal.wheel_radius_m / pulses

    def wheel_speeds(self, v_mps: ArrayLike, omega_radps: ArrayLike) -> Array:
        """Ground speeds (..., 2) of wheels that do not slip at a commanded body velocity, m/s.

        The controller sets the wheels' rates by its nominal geometry; the wheels roll by the true
        radius.
        """
        nominal = self.nominal
        v, turn = np.asarray(v_mps, float), np.asarray(omega_radps, float) * nominal.track_m / 2.0
        speeds: Array = np.stack([v + turn, v - turn], axis=-1)
        return speeds * (self.wheel_radius_m / nominal.wheel_radius_m)

    def slips(self, dt_s: float) -> tuple[Slip, Slip]:
        """Slip of the right and the left wheel of the robot at rest."""
        return Slip(self.kr, self.bias_right, dt_s), Slip(self.kl, self.bias_left, dt_s)

    def encoder_reading(self, position_m: Array) -> Array:
        """What the encoders report (..., 2), m, at positions (..., 2) along the ground, m.

        The wheel's angle, in whole counts, times the nominal radius. Positions are quantised,
        never increments, so the error does not accumulate.
        """
        reading = position_m * (self.nominal.wheel_radius_m / self.wheel_radius_m)
        quantum_m = self.encoder_quantum_m
        return np.floor(reading / quantum_m) * quantum_m if quantum_m > 0.0 else reading


@dataclass(frozen=True)
class RobotGeometry:
    """What is believed of the robot: the wheel radius and the track, m."""

    wheel_radius_m: float
    track_m: float

    def __post_init__(self) -> None:
        check_numbers("prior", self, ("wheel_radius_m", "track_m"))


def wheel_variances(travel_m: ArrayLike, kr: float, kl: float) -> Array:
    """Variances (..., 2) m^2 of wheel increments (..., 2): k |ds| (puzzlebot2024, eq. (5))."""
    return np.asarray(np.abs(np.asarray(travel_m, float)) * np.array([kr, kl]))


def wheel_errors(travel_m: ArrayLike, variance_per_m: ArrayLike, rng: np.random.Generator) -> Array:
    """Zero-mean encoder errors, m, of variance k |ds|: the slip law of `Slip` without its lag.

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
    return np.asarray(scaled_error(travel, variance_per_m, rng.standard_normal(travel.shape)))


def scaled_error(travel_m: Any, variance_per_m: Any, standard_normal: Any) -> Any:
    """Encoder error, m, of variance k |ds| from a normal drawn beforehand."""
    if isinstance(travel_m, float):  # NumPy's call would cost ten times more
        return math.sqrt(variance_per_m * abs(travel_m)) * standard_normal
    return np.sqrt(variance_per_m * np.abs(travel_m)) * standard_normal


@dataclass
class Slip:
    """The slip of one wheel, tick by tick; in floats for one robot, in arrays for a batch.

    At each tick the wheel is driven at `command - correction_mps`; it rolls `rolling_m` on the
    ground and its encoder reads that plus an error of variance k |rolling|, white over ticks.
    The error flows back into the drive through a first-order lag, because the wheel's speed
    loop is closed on the encoder: over times beyond the lag the encoder follows the command and
    the ground travel wanders.

    Attributes
    ----------
    variance_per_m, bias
        k, m, and the share by which the encoder reads more than the wheel rolls.
    dt_s
        Length of a tick.
    lag_m
        State of the lag.
    """

    variance_per_m: float
    bias: float
    dt_s: float
    lag_m: Any = 0.0

    @property
    def correction_mps(self) -> Any:
        """Speed to take off the wheel's command at the next tick, m/s."""
        return self.lag_m / self.dt_s

    def advance(self, rolling_m: Any, standard_normal: Any, extra_m: Any = 0.0) -> Any:
        """Encoder increment, m, of a tick in which the wheel rolled `rolling_m`.

        `extra_m` is an encoder error from outside the law.
        """
        error = self.bias * rolling_m + extra_m
        error += scaled_error(rolling_m, self.variance_per_m, standard_normal)
        self.lag_m += (self.dt_s / SLIP_TIME_CONSTANT_S) * (error - self.lag_m)
        return rolling_m + error


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
