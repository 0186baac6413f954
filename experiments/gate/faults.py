"""Faults planted in the estimators' code, to measure what `estima check` finds.

There are three kinds: a wrong entry of a derivative (or of the geometry behind it), lost
observations, and noise that is added or overestimated. Each has a size. No error is ever scaled.
"""

import dataclasses
import math
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from typing import Any
from unittest import mock

import numpy as np

from estimators import odometry, wheels
from estimators.base import Estimator, Prior
from estimators.gaussian import Gaussian
from estimators.landmarks.stereo import StereoModel
from estimators.laser import ekf_icp, ekf_icp_paper
from estimators.laser.scan_matching import Match, ScanMatcher
from experiments.gate.suite import Planted
from sim.arrays import Array
from sim.recording import Frame
from sim.robot.slip import wheel_errors
from sim.sensors import Laser, Reading, sensor_of

Fault = Callable[[float], Planted]  # of a size


def in_argument_of(
    method: str,
) -> Callable[[Callable[[Any, float, np.random.Generator], Any]], Fault]:
    """Make a fault of a function that changes the first argument of an estimator's method.

    It is called with the sound argument, the fault's size and a generator.
    """

    def decorate(change: Callable[[Any, float, np.random.Generator], Any]) -> Fault:
        def plant(
            size: float, estimator: Estimator, rng: np.random.Generator
        ) -> AbstractContextManager[object]:
            sound = getattr(estimator, method)
            return mock.patch.object(
                estimator, method, lambda first, *rest: sound(change(first, size, rng), *rest)
            )

        return lambda size: partial(plant, size)

    return decorate


def in_place_of(owner: Any, name: str) -> Callable[[Callable[..., Any]], Fault]:
    """Make a fault of a function that takes the place of an attribute.

    It is called with the sound function, the fault's size and the sound function's arguments.
    """

    def decorate(wrong: Callable[..., Any]) -> Fault:
        def plant(size: float, *_: object) -> AbstractContextManager[object]:
            sound = getattr(owner, name)
            return mock.patch.object(owner, name, lambda *a, **k: wrong(sound, size, *a, **k))

        return lambda size: partial(plant, size)

    return decorate


def lose_readings(name: str) -> Fault:
    """Each reading of a sensor is dropped with some probability."""

    @in_argument_of("step")
    def fault(frame: Frame, share: float, rng: np.random.Generator) -> Frame:
        return _reading(frame, name, None) if rng.random() < share else frame

    return fault


@in_argument_of("step")
def lost_landmarks(frame: Frame, share: float, rng: np.random.Generator) -> Frame:
    """Each observation of a landmark is dropped with some probability."""
    seen = frame.readings.get("stereo")
    if seen is None:
        return frame
    kept = rng.random(len(seen["points_in_camera"])) >= share
    return _reading(frame, "stereo", {name: values[kept] for name, values in seen.items()})


@in_argument_of("step")
def lost_increments(frame: Frame, share: float, rng: np.random.Generator) -> Frame:
    """Each reading of the wheels is dropped with some probability, and its travel with it."""
    gone = rng.random() < share
    return dataclasses.replace(frame, wheel_increments_m=np.zeros(2)) if gone else frame


@in_argument_of("step")
def noisy_increments(frame: Frame, k: float, rng: np.random.Generator) -> Frame:
    """Noise of variance k |ds| is added to the wheel increments."""
    travel = frame.wheel_increments_m
    return dataclasses.replace(frame, wheel_increments_m=travel + wheel_errors(travel, k, rng))


@in_argument_of("step")
def noisy_ranges(frame: Frame, sigma_m: float, rng: np.random.Generator) -> Frame:
    """Noise is added to the ranges."""
    scan = frame.readings.get("laser")
    if scan is None:
        return frame
    noise = sigma_m * rng.standard_normal(scan["ranges_m"].shape)
    return _reading(frame, "laser", {"ranges_m": (scan["ranges_m"] + noise).astype(np.float32)})


@in_argument_of("step")
def noisy_descriptors(frame: Frame, sigma: float, rng: np.random.Generator) -> Frame:
    """Noise of this mean length is added to the place descriptors."""
    place = frame.readings.get("place")
    if place is None:
        return frame
    seen = place["descriptor"]
    noise = sigma / math.sqrt(len(seen)) * rng.standard_normal(len(seen))
    return _reading(frame, "place", {"descriptor": (seen + noise).astype(np.float32)})


def _reading(frame: Frame, name: str, reading: Reading | None) -> Frame:
    """Return the Frame with another reading of a sensor, or with none."""
    others = {key: value for key, value in frame.readings.items() if key != name}
    return dataclasses.replace(
        frame, readings=others if reading is None else {**others, name: reading}
    )


@in_argument_of("step")
def wrong_travel(frame: Frame, share: float, _: np.random.Generator) -> Frame:
    """Wheel travel is overestimated, as with a wrong radius."""
    return dataclasses.replace(frame, wheel_increments_m=(1.0 + share) * frame.wheel_increments_m)


@in_argument_of("reset")
def wrong_mount(prior: Prior, offset_m: float, _: np.random.Generator) -> Prior:
    """The laser is believed to be mounted further ahead than it is."""
    laser = sensor_of(prior.sensors, "laser", Laser)
    mount = dataclasses.replace(laser.mount, x_m=laser.mount.x_m + offset_m)
    laser = dataclasses.replace(laser, mount=mount)
    return dataclasses.replace(prior, sensors={**prior.sensors, "laser": laser})


@in_place_of(odometry, "relative_motion")
def wrong_track(sound: Any, share: float, travel_m: Array, track_m: float, form: str) -> Any:
    """The track in the heading's row of the wheels' matrix is too long."""
    return sound(travel_m, (1.0 + share) * track_m, form)


@in_place_of(ekf_icp, "between")
def wrong_between(sound: Any, share: float, first: Array, second: Array) -> Any:
    """The derivative of a relative heading with respect to the robot's own is too large."""
    pose, by_first, by_second = sound(first, second)
    by_second[2, 2] *= 1.0 + share
    return pose, by_first, by_second


@in_place_of(ekf_icp_paper, "observation")
def wrong_observation(sound: Any, share: float, state: Array) -> Any:
    """The velocity's derivative with respect to the heading is too large."""
    velocity, H = sound(state)
    H[:2, 2] *= 1.0 + share
    return velocity, H


@in_place_of(StereoModel, "predict")
def wrong_prediction(sound: Any, share: float, *arguments: Any) -> Any:
    """The derivative of a landmark's predicted point with respect to the heading is too large."""
    points, by_pose, by_landmark = sound(*arguments)
    return points, by_pose * [1.0, 1.0, 1.0 + share], by_landmark


@in_place_of(wheels, "wheel_motion")
def wrong_wheels(sound: Any, share: float, *arguments: Any) -> tuple[Gaussian, Array]:
    """The heading's row of the motion's derivative with respect to the wheels is too large."""
    scale = np.array([1.0, 1.0, 1.0 + share])
    motion, by_wheels = sound(*arguments)
    covariance = scale[:, None] * motion.covariance * scale
    return Gaussian(motion.mean, covariance), scale[:, None] * by_wheels


@in_place_of(wheels, "wheel_variances")
def inflated_wheels(sound: Any, share: float, *arguments: Any) -> Any:
    """The slip of the wheels is believed too large."""
    return (1.0 + share) * sound(*arguments)


@in_place_of(ScanMatcher, "match")
def inflated_registration(sound: Any, share: float, *arguments: Any, **keywords: Any) -> Match:
    """The covariance of registrations is believed too large."""
    found: Match = sound(*arguments, **keywords)
    motion = Gaussian(found.motion.mean, (1.0 + share) * found.motion.covariance)
    return dataclasses.replace(found, motion=motion)


@in_place_of(StereoModel, "of")
def inflated_camera(sound: Any, share: float, *arguments: Any, **keywords: Any) -> StereoModel:
    """The camera's noise is believed too large."""
    model: StereoModel = sound(*arguments, **keywords)
    return dataclasses.replace(model, variances_px2=(1.0 + share) * model.variances_px2)


# Each fault, by option of conf/estimator, with the size from which the search for its grade starts.
FAULTS: dict[str, dict[str, tuple[Fault, float]]] = {
    "odometry": {
        "derivative": (wrong_track, 0.02),
        "lost": (lost_increments, 0.01),
        "noise": (noisy_increments, 5e-5),
    },
    "icp_odometry": {
        "derivative": (wrong_mount, 0.005),
        "lost": (lose_readings("laser"), 0.2),
        "noise": (noisy_ranges, 0.005),
    },
    "ekf_icp": {
        "derivative": (wrong_between, 0.1),
        "lost": (lose_readings("laser"), 0.2),
        "noise": (inflated_registration, 2.0),
    },
    "ekf_icp_paper": {
        "derivative": (wrong_observation, 0.1),
        "lost": (lose_readings("laser"), 0.05),
        "noise": (inflated_registration, 1.0),
    },
    "ekf_slam": {
        "derivative": (wrong_prediction, 0.05),
        "lost": (lost_landmarks, 0.2),
        "noise": (inflated_camera, 2.0),
    },
    "smoother": {
        "derivative": (wrong_wheels, 1.0),
        "lost": (lost_landmarks, 0.2),
        "noise": (inflated_camera, 2.0),
    },
    "fastslam": {
        "derivative": (wrong_wheels, 0.5),
        "lost": (lost_landmarks, 0.2),
        "noise": (inflated_camera, 2.0),
    },
    "fastslam_paper": {
        "derivative": (wrong_wheels, 0.5),
        "lost": (lost_landmarks, 0.2),
        "noise": (inflated_camera, 2.0),
    },
    "fixed_lag": {
        "derivative": (wrong_wheels, 1.0),
        "lost": (lost_landmarks, 0.2),
        "noise": (inflated_camera, 2.0),
    },
    "graph_slam": {
        "derivative": (wrong_mount, 0.005),
        "lost": (lose_readings("laser"), 0.2),
        "noise": (noisy_ranges, 0.005),
    },
    "mcl": {
        "derivative": (wrong_wheels, 0.5),
        "lost": (lose_readings("laser"), 0.3),
        "noise": (inflated_wheels, 1.0),
    },
    "topological_mcl": {
        "derivative": (wrong_travel, 0.2),
        "lost": (lose_readings("place"), 0.1),
        "noise": (noisy_descriptors, 0.3),
    },
}
