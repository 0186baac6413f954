"""What estimators ask of their Prior, and the options of most; an error names the remedy."""

from typing import TypeVar

from estimators.base import Prior
from estimators.gaussian import Gaussian
from sim.errors import InputError, required
from sim.options import options
from sim.sensors import Laser, StereoCamera, sensor_of

S = TypeVar("S")


@options("estimator")
class LaserOptions:
    """Options of a method that reads a laser."""

    laser: str = "laser"
    """Name of the laser that it reads."""


def start_pose(prior: Prior, estimator: str) -> Gaussian:
    """Copy of the prior's pose in map, without which this estimator cannot start."""
    start = required(prior.start, f"{estimator} needs a start pose; set prior.start=tracking")
    return Gaussian(start.mean.copy(), start.covariance.copy())


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
