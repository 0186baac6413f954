"""Faults planted in the estimators' code, to learn what `estima check` finds.

Three kinds: a wrong entry of a derivative (or of the geometry it stands for), a lost observation,
an inflated noise. Each has a size. No error is ever scaled.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from typing import Any
from unittest import mock

import numpy as np
from numpy.typing import NDArray

from estimators import ekf_icp, ekf_icp_paper, odometry, wheels
from estimators.base import Belief, Estimator, Prior
from estimators.gaussian import Gaussian
from estimators.scan_matching import Match, ScanMatcher
from estimators.stereo import StereoModel
from sim.recording import Frame, LandmarkSet
from sim.robot import wheel_errors

Array = NDArray[np.float64]
Planted = Callable[[Estimator, np.random.Generator], AbstractContextManager[Estimator]]
Fault = Callable[[float], Planted]  # of a size


def changed(change: Callable[[Frame, np.random.Generator], Frame]) -> Planted:
    """Hand the estimator changed Frames."""

    @contextmanager
    def plant(estimator: Estimator, rng: np.random.Generator) -> Iterator[Estimator]:
        sound = estimator.step

        def step(frame: Frame) -> Belief:
            return sound(change(frame, rng))

        with mock.patch.object(estimator, "step", step):
            yield estimator

    return plant


def patched(*patches: tuple[Any, str, Callable[[Any], Any]]) -> Planted:
    """Put another function in place of an attribute: what `wrap(sound one)` gives."""

    @contextmanager
    def plant(estimator: Estimator, rng: np.random.Generator) -> Iterator[Estimator]:
        with ExitStack() as stack:
            for owner, name, wrap in patches:
                stack.enter_context(mock.patch.object(owner, name, wrap(getattr(owner, name))))
            yield estimator

    return plant


def lost(name: str) -> Fault:
    """Each datum of a sensor goes missing with some chance."""

    def fault(share: float) -> Planted:
        def change(frame: Frame, rng: np.random.Generator) -> Frame:
            nothing: dict[str, Any] = {name: None}
            return dataclasses.replace(frame, **nothing) if rng.random() < share else frame

        return changed(change)

    return fault


def lost_landmarks(share: float) -> Planted:
    """Each observation of a landmark goes missing with some chance."""

    def change(frame: Frame, rng: np.random.Generator) -> Frame:
        seen = frame.landmarks
        if seen is None:
            return frame
        kept = rng.random(len(seen.points_in_camera)) >= share
        parts = (seen.points_in_camera, seen.ids, seen.descriptors)
        left = LandmarkSet(*(None if part is None else part[kept] for part in parts))  # type: ignore[arg-type]
        return dataclasses.replace(frame, landmarks=left)

    return changed(change)


def lost_increments(share: float) -> Planted:
    """Each reading of the wheels goes missing with some chance, and its travel with it."""

    def change(frame: Frame, rng: np.random.Generator) -> Frame:
        gone = rng.random() < share
        return dataclasses.replace(frame, wheel_increments_m=np.zeros(2)) if gone else frame

    return changed(change)


def noisy_increments(k: float) -> Planted:
    """Wheel increments with noise of variance k |ds| added."""

    def change(frame: Frame, rng: np.random.Generator) -> Frame:
        travel = frame.wheel_increments_m
        noisy = travel + wheel_errors(travel, k, rng)
        return dataclasses.replace(frame, wheel_increments_m=noisy)

    return changed(change)


def noisy_ranges(sigma_m: float) -> Planted:
    """Ranges with noise added."""

    def change(frame: Frame, rng: np.random.Generator) -> Frame:
        if frame.ranges_m is None:
            return frame
        noise = sigma_m * rng.standard_normal(frame.ranges_m.shape)
        return dataclasses.replace(frame, ranges_m=(frame.ranges_m + noise).astype(np.float32))

    return changed(change)


def noisy_descriptors(sigma: float) -> Planted:
    """Place descriptors with noise added, of this length on average."""

    def change(frame: Frame, rng: np.random.Generator) -> Frame:
        seen = frame.place_descriptor
        if seen is None:
            return frame
        noise = sigma / math.sqrt(len(seen)) * rng.standard_normal(len(seen))
        return dataclasses.replace(frame, place_descriptor=(seen + noise).astype(np.float32))

    return changed(change)


def wrong_track(share: float) -> Planted:
    """The track in the heading's row of the wheels' matrix is too long."""

    def wrap(sound: Any) -> Any:
        return lambda travel_m, track_m, form: sound(travel_m, (1.0 + share) * track_m, form)

    return patched((odometry, "relative_motion", wrap))


def wrong_mount(offset_m: float) -> Planted:
    """The laser sits elsewhere on the robot than believed."""

    @contextmanager
    def plant(estimator: Estimator, rng: np.random.Generator) -> Iterator[Estimator]:
        sound = estimator.reset

        def reset(prior: Prior, rng: np.random.Generator) -> None:
            laser = prior.sensors.laser
            assert laser is not None
            mount = dataclasses.replace(laser.mount, x_m=laser.mount.x_m + offset_m)
            laser = dataclasses.replace(laser, mount=mount)
            sensors = dataclasses.replace(prior.sensors, laser=laser)
            sound(dataclasses.replace(prior, sensors=sensors), rng)

        with mock.patch.object(estimator, "reset", reset):
            yield estimator

    return plant


def wrong_between(share: float) -> Planted:
    """The derivative of a relative heading by the robot's own is too large."""

    def wrap(sound: Any) -> Any:
        def between(first: Array, second: Array) -> tuple[Array, Array, Array]:
            pose, by_first, by_second = sound(first, second)
            by_second[2, 2] *= 1.0 + share
            return pose, by_first, by_second

        return between

    return patched((ekf_icp, "between", wrap))


def wrong_observation(share: float) -> Planted:
    """The velocity's derivative by the heading is too large."""

    def wrap(sound: Any) -> Any:
        def observation(state: Array) -> tuple[Array, Array]:
            velocity, H = sound(state)
            H[:2, 2] *= 1.0 + share
            return velocity, H

        return observation

    return patched((ekf_icp_paper, "observation", wrap))


def wrong_prediction(share: float) -> Planted:
    """The derivative of a landmark's predicted point by the heading is too large."""

    def wrap(sound: Any) -> Any:
        def predict(self: StereoModel, pose: Array, landmarks: Array) -> tuple[Array, Array, Array]:
            points, by_pose, by_landmark = sound(self, pose, landmarks)
            by_pose = by_pose * [1.0, 1.0, 1.0 + share]
            return points, by_pose, by_landmark

        return predict

    return patched((StereoModel, "predict", wrap))


def wrong_wheels(share: float) -> Planted:
    """The heading's row of the motion's derivative by the wheels is too large."""
    scale = np.array([1.0, 1.0, 1.0 + share])

    def wrap(sound: Any) -> Any:
        def wheel_motion(*arguments: Any) -> tuple[Gaussian, Array]:
            motion, by_wheels = sound(*arguments)
            covariance = scale[:, None] * motion.covariance * scale
            return Gaussian(motion.mean, covariance), scale[:, None] * by_wheels

        return wheel_motion

    return patched((wheels, "wheel_motion", wrap))


def wrong_travel(share: float) -> Planted:
    """The wheels' travel is believed too long, as by a wrong radius."""

    def change(frame: Frame, rng: np.random.Generator) -> Frame:
        travel = (1.0 + share) * frame.wheel_increments_m
        return dataclasses.replace(frame, wheel_increments_m=travel)

    return changed(change)


def inflated_wheels(share: float) -> Planted:
    """The slip of the wheels is believed too large."""

    def wrap(sound: Any) -> Any:
        return lambda *arguments: (1.0 + share) * sound(*arguments)

    return patched((wheels, "wheel_variances", wrap))


def inflated_registration(share: float) -> Planted:
    """The covariance of registrations is believed too large."""

    def wrap(sound: Any) -> Any:
        def match(self: ScanMatcher, *arguments: Any, **more: Any) -> Match:
            found: Match = sound(self, *arguments, **more)
            motion = Gaussian(found.motion.mean, (1.0 + share) * found.motion.covariance)
            return dataclasses.replace(found, motion=motion)

        return match

    return patched((ScanMatcher, "match", wrap))


def inflated_camera(share: float) -> Planted:
    """The camera's noise is believed too large."""

    def wrap(sound: Any) -> Any:
        def of(*arguments: Any, **more: Any) -> StereoModel:
            model: StereoModel = sound(*arguments, **more)
            return dataclasses.replace(model, variances_px2=(1.0 + share) * model.variances_px2)

        return of

    return patched((StereoModel, "of", wrap))


# Each with a size to start the search from.
FAULTS: dict[str, dict[str, tuple[Fault, float]]] = {
    "odometry": {
        "derivative": (wrong_track, 0.02),
        "lost": (lost_increments, 0.01),
        "noise": (noisy_increments, 5e-5),
    },
    "icp_odometry": {
        "derivative": (wrong_mount, 0.005),
        "lost": (lost("ranges_m"), 0.2),
        "noise": (noisy_ranges, 0.005),
    },
    "ekf_icp": {
        "derivative": (wrong_between, 0.1),
        "lost": (lost("ranges_m"), 0.2),
        "noise": (inflated_registration, 2.0),
    },
    "ekf_icp_paper": {
        "derivative": (wrong_observation, 0.1),
        "lost": (lost("ranges_m"), 0.05),
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
    "mcl": {
        "derivative": (wrong_wheels, 0.5),
        "lost": (lost("ranges_m"), 0.3),
        "noise": (inflated_wheels, 1.0),
    },
    "topological_mcl": {
        "derivative": (wrong_travel, 0.2),
        "lost": (lost("place_descriptor"), 0.1),
        "noise": (noisy_descriptors, 0.3),
    },
}
