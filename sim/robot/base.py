"""The interface of a robot; implement it for another kind of robot, as `sim.robot.drive` does."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from sim.arrays import Array, ArrayLike
from sim.errors import require
from sim.options import build, find
from sim.robot.slip import SlipLaw

TICKS_PER_S = 300
TICK_S = 1.0 / TICKS_PER_S
_DEFAULT = "sim.robot.drive.DifferentialDrive"


@dataclass(frozen=True)
class RobotGeometry:
    """Assumed geometry of the robot: wheel radius and track, m."""

    wheel_radius_m: float
    track_m: float

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            require(0.0 < value < np.inf, f"prior.{name} must be a positive number, got {value}")


class Robot(Protocol):
    """A robot with a right and a left side to drive, its body centred over the axle: the truth."""

    @property
    def wheel_radius_m(self) -> float:
        """Radius by which the wheels roll."""

    @property
    def track_m(self) -> float:
        """Distance between the sides by which the body turns."""

    @property
    def body_length_m(self) -> float:
        """Length of the body, along x."""

    @property
    def body_width_m(self) -> float:
        """Width of the body."""

    @property
    def body_height_m(self) -> float:
        """Top of the body above the ground."""

    @property
    def mass_kg(self) -> float:
        """Mass of the whole robot."""

    @property
    def max_acceleration_mps2(self) -> float:
        """Limit of each wheel's acceleration along the ground."""

    @property
    def nominal(self) -> RobotGeometry:
        """The geometry that the robot's controller uses, and that its recordings state."""

    def wheel_speeds(self, v_mps: ArrayLike, omega_radps: ArrayLike) -> Array:
        """Ground speeds (..., 2) of wheels that do not slip at a commanded body velocity, m/s."""

    def start_slip(self, dt_s: float, rng: np.random.Generator) -> SlipLaw:
        """Slip at work of the robot at rest, at ticks of `dt_s`."""

    def encoder_reading(self, position_m: Array) -> Array:
        """What the encoders report (..., 2), m, at positions (..., 2) along the ground, m."""


def robot_from_config(settings: Mapping[str, Any]) -> Robot:
    """Robot of a mapping with `_target_`; without one, a `DifferentialDrive`.

    Raises
    ------
    InputError
        For a class that cannot be found or is not a robot, an unknown key, or a bad value.
    """
    target = settings.get("_target_", _DEFAULT)
    kind: Any = find(target, "robot")
    require(dataclasses.is_dataclass(kind), f"robot._target_={target} must be a dataclass")
    has = {*dir(kind), *(field.name for field in dataclasses.fields(kind))}
    missing = [name for name in vars(Robot) if not (name.startswith("_") or name in has)]
    require(
        not missing,
        f"robot._target_={target} has no {', '.join(missing)}; see sim.robot.base.Robot",
    )
    own = {key: value for key, value in settings.items() if key != "_target_"}
    made: Robot = build(kind, own, "robot")
    return made
