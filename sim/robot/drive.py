"""The differential-drive robot: true and nominal geometry, encoders, and the kr/kl slip law.

Wheel quantities come in pairs in the order (right, left), in metres along the ground.
"""

import math
from functools import cached_property

import numpy as np
from pydantic import NonNegativeInt

from sim.arrays import Array, ArrayLike
from sim.errors import require
from sim.options import NonNegative, Positive, options
from sim.robot.base import RobotGeometry
from sim.robot.slip import SlipOptions

__all__ = ["DifferentialDrive", "RobotGeometry"]


@options("robot")
class DifferentialDrive(SlipOptions):
    """What the simulated robot is and how its wheels slip: the truth, never an estimator's belief.

    The nominal geometry is part of that truth: it is what the robot's own controller uses, right
    or wrong. The body is centred over the axle.
    """

    wheel_radius_m: Positive
    track_m: Positive
    """Distance between the wheels' contact points."""
    nominal_wheel_radius_m: Positive | None = None
    """Radius by which the robot's controller turns body velocities into wheel speeds and wheel
    angles into metres; null for the true one."""
    nominal_track_m: Positive | None = None
    """Track that the controller uses; null for the true one. A robot whose nominal track is 0.44 of
    the true one turns by 0.44 of what it is commanded."""
    encoder_tick_m: NonNegative = 0.0
    """Quantum of the encoder counts, in metres that the encoder reports; 0 for no quantisation."""
    encoder_pulses_per_turn: NonNegativeInt = 0
    """Pulses per turn of the encoder's shaft, in place of `encoder_tick_m`; 0 for none."""
    gear_ratio: Positive = 1.0
    """Turns of the encoder's shaft for one turn of the wheel."""
    body_length_m: Positive = 0.18
    body_width_m: Positive = 0.14
    body_height_m: Positive = 0.10
    mass_kg: Positive = 1.3
    max_acceleration_mps2: Positive = 1.0
    """Limit of each wheel's acceleration along the ground."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("nominal_wheel_radius_m", "nominal_track_m"):
            believed = getattr(self, name)
            if believed is not None:
                ratio = believed / getattr(self, name.removeprefix("nominal_"))
                require(
                    0.1 <= ratio <= 10.0,
                    f"robot.{name} must lie within a factor of ten of the true one, "
                    f"got {ratio:.3g} times it",
                )
        require(
            not self.encoder_pulses_per_turn or not self.encoder_tick_m,
            "robot.encoder_pulses_per_turn and robot.encoder_tick_m both set the encoder's "
            "quantum; set one of them to 0",
        )
        require(
            self.gear_ratio == 1.0 or self.encoder_pulses_per_turn,
            "robot.gear_ratio has no effect without pulses; set robot.encoder_pulses_per_turn, "
            "or robot.gear_ratio=1",
        )

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

    def encoder_reading(self, position_m: Array) -> Array:
        """What the encoders report (..., 2), m, at positions (..., 2) along the ground, m.

        The wheel's angle, in whole counts, times the nominal radius. Positions are quantised,
        never increments, so the error does not accumulate.
        """
        reading = position_m * (self.nominal.wheel_radius_m / self.wheel_radius_m)
        quantum_m = self.encoder_quantum_m
        return np.floor(reading / quantum_m) * quantum_m if quantum_m > 0.0 else reading
