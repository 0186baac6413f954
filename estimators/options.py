"""Checks of an estimator's options and of its Prior; an error names the key and the remedy."""

import math
from collections.abc import Callable
from typing import Any, TypeVar, get_args

from estimators.base import Prior
from estimators.gaussian import Gaussian
from sim.errors import InputError, require
from sim.options import options
from sim.sensors import Laser, StereoCamera, sensor_of

S = TypeVar("S")


@options("estimator")
class LaserOptions:
    """Options of a method that reads a laser."""

    laser: str = "laser"
    """Name of the laser that it reads."""


def require_choices(owner: str = "estimator.", /, **choices: tuple[str, Any]) -> None:
    """Each option is given as (value, Literal): the value must be one of the Literal's."""
    for name, (value, kind) in choices.items():
        if value not in get_args(kind):
            allowed = ", ".join(get_args(kind))
            raise InputError(f"{owner}{name} must be one of {allowed}, got {value!r}")


def require_non_negative(**options: float) -> None:
    """Each option must be a finite number, zero or more."""
    _require(options, "zero or a positive number", lambda number: number >= 0.0)


def require_positive(**options: float) -> None:
    """Each option must be a finite number above zero."""
    _require(options, "a positive number", lambda number: number > 0.0)


def require_shares(**options: float) -> None:
    """Each option must lie in [0, 1]."""
    _require(options, "a number in [0, 1]", lambda number: 0.0 <= number <= 1.0)


def require_counts(most: int | None = None, /, **options: int) -> None:
    """Each option must be a whole number, one or more, and no more than `most` if that is given."""
    bounds = "at least 1" if most is None else f"from 1 to {most}"
    for name, count in options.items():
        require(
            not isinstance(count, bool)
            and isinstance(count, int)
            and count >= 1
            and (most is None or count <= most),
            f"estimator.{name} must be a whole number, {bounds}, got {count!r}",
        )


def _require(options: dict[str, float], wanted: str, holds: Callable[[float], bool]) -> None:
    for name, number in options.items():
        require(
            isinstance(number, int | float)
            and not isinstance(number, bool)
            and math.isfinite(number)
            and holds(number),
            f"estimator.{name} must be {wanted}, got {number!r}",
        )


def start_pose(prior: Prior, estimator: str) -> Gaussian:
    """Copy of the prior's pose in map, without which this estimator cannot start."""
    if prior.mean is None or prior.covariance is None:
        raise InputError(f"{estimator} needs a start pose; set prior.start=tracking")
    return Gaussian(prior.mean.copy(), prior.covariance.copy())


def require_laser(prior: Prior, name: str, estimator: str) -> Laser:
    """Return the laser of a name, without which this estimator cannot start."""
    return _required(prior, name, Laser, estimator)


def require_stereo(prior: Prior, name: str, estimator: str) -> StereoCamera:
    """Return the stereo camera of a name, without which this estimator cannot start."""
    return _required(prior, name, StereoCamera, estimator)


def _required(prior: Prior, name: str, kind: type[S], estimator: str) -> S:
    try:
        return sensor_of(prior.sensors, name, kind)
    except InputError as error:
        raise InputError(f"{estimator}: {error}") from None
