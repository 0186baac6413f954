"""The bound on the errors over a recording, beside which the estimates' own stand.

What is bounded is the error of a method that knows the law of the wheels and of the sensors, their
true figures, the start within its prior, and which landmark is which. Per recording the information
is evaluated at its own true path, so it is the bound on the error pooled over recordings of the
setting (Tichavsky, Muravchik and Nehorai average the information over paths before they invert it,
which is lower, by Jensen); a single recording may come out below it. It is that of the linearised
problem: it means little where errors are so great that lines are no longer straight, as after long
dead reckoning. The encoder's error is taken as white beside what the encoder shows, and what
landmarks are *not* seen, or which beams return nothing, tells nothing.
"""

import functools
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from estimators.base import Prior
from experiments.evaluation.pose_bound import (
    Chain,
    PathBound,
    Sights,
    bound_dead_reckoning,
    bound_path,
)
from experiments.evaluation.sensor_information import (
    WheelNoise,
    laser_information,
    motion_terms,
    stereo_information,
)
from sim.arrays import Array, Ints
from sim.recording import Recording
from sim.robot.arc import arc_increment, arc_increment_jacobian
from sim.robot.base import robot_from_config
from sim.robot.drive import DifferentialDrive
from sim.sensors import Encoder, Laser, Sensor, StereoCamera
from sim.worlds.world import World

_BENT_RAD2 = 0.3**2  # variance of a heading from which on sensors are not linearised


@dataclass(frozen=True)
class _Known:
    """What the bound depends on; the recording by its checksum."""

    checksum: str
    sensors: tuple[str, ...]
    start: bytes
    landmarks: bool
    recording: Recording = field(compare=False, repr=False)


def bound_recording(recording: Recording, prior: Prior, names: Iterable[str]) -> PathBound | None:
    """Bound at each Frame of a recording; it is made once for several runs.

    None where there is no bound: over a recording that was not simulated, without a start, of a
    robot or a sensor of another law, with a laser but without a map, where rounding loses what
    is known of a landmark, and where a heading is off by more than the linearised problem allows.

    Parameters
    ----------
    names
        Sensors that are read.
    """
    read = tuple(name for name in names if not isinstance(recording.sensors.get(name), Encoder))
    sensors = [recording.sensors.get(name) for name in read]
    blind = any(isinstance(sensor, Laser) for sensor in sensors) and prior.map is None
    if blind or prior.covariance is None or not _is_known(recording, sensors):
        return None
    start, landmarks = prior.covariance.tobytes(), isinstance(prior.map, World)
    bound = _bound(_Known(recording.checksum, read, start, landmarks, recording))
    if bound is None or not np.isfinite(bound.online).all():
        return None
    straight = not read or max(prior.covariance[2, 2], bound.online[:, 2, 2].max()) < _BENT_RAD2
    return bound if straight else None


def bound_scores(covariances: Array) -> dict[str, float]:
    """Root mean squares of bounds (T, 3, 3) over Frames, as columns of a row."""
    x, y, heading = np.diagonal(covariances, axis1=1, axis2=2).mean(axis=0)
    return {
        "bound_rmse_m": float(np.sqrt(x + y)),
        "bound_heading_rad": float(np.sqrt(heading)),
    }


def _is_known(recording: Recording, sensors: list[Sensor | None]) -> bool:
    """Whether the law of the wheels and of the sensors is known, and the sensors see a world."""
    truth, made_with = recording.truth, recording.config.get("robot")
    if truth is None or truth.world is None or not len(truth.wheel_travel_m):
        return False
    ours = f"{DifferentialDrive.__module__}.{DifferentialDrive.__qualname__}"
    # a file does not choose what code runs
    if not isinstance(made_with, dict) or made_with.get("_target_", ours) != ours:
        return False
    return all(
        (type(sensor) is Laser and sensor.sigma_range_m > 0.0 and sensor.sweep_s == 0.0)
        or (
            isinstance(sensor, StereoCamera)
            and min(sensor.sigma_column_px, sensor.sigma_row_px, sensor.sigma_disparity_px) > 0.0
        )
        for sensor in sensors
    )


@functools.lru_cache(maxsize=4)
def _bound(known: _Known) -> PathBound | None:
    """The bound over all Frames of a recording; None where rounding has spoilt it."""
    recording, start = known.recording, np.frombuffer(known.start).reshape(3, 3)
    travel_m, wheels = _travel_and_slip(recording)
    if not known.sensors:
        steps, by_wheels = (
            arc_increment(travel_m, wheels.track_m),
            arc_increment_jacobian(travel_m, wheels.track_m),
        )
        alone = bound_dead_reckoning(start, steps, by_wheels, wheels.covariances(travel_m))
        return PathBound(alone, alone)
    poses = recording.truth_at(recording.frame_stamps)
    by_before, noise = motion_terms(poses, travel_m, wheels)
    chain = Chain(start, by_before, noise, np.zeros_like(noise))
    for name in known.sensors:
        sensor, log = recording.sensors[name], recording.logs[name]
        rows = np.searchsorted(recording.frame_stamps, log.stamps)
        if isinstance(sensor, Laser):
            told = laser_information(recording.known_world, sensor, poses[rows], log["ranges_m"])
            np.add.at(chain.information, rows, told)
        elif isinstance(sensor, StereoCamera):
            seen = np.asarray(recording.known_truth.readings[name]["true_ids"], np.int64)
            frames = np.repeat(rows, np.diff(log.known_splits))
            points = recording.known_world.landmarks[seen]
            of_pose, cross, own = stereo_information(sensor, poses[frames], points)
            np.add.at(chain.information, frames, of_pose)
            if not known.landmarks:
                sights = Sights(frames, _by_first_sight(seen), cross, own)
                chain = chain._replace(sights=sights)
    try:
        return bound_path(chain)
    except np.linalg.LinAlgError:
        return None


def _travel_and_slip(recording: Recording) -> tuple[Array, WheelNoise]:
    """Ground travel (T, 2) of the wheels by the encoders, and how far it may be off."""
    robot: Any = robot_from_config(recording.config["robot"])
    gain = 1.0 + robot.slip_bias  # the encoder reads so much more than the wheel rolls
    # shared slip that lasts is not white; without it the bound is lower
    together = 0.0 if robot.forward_slip_length_m else robot.forward_slip_m / float(gain.max()) ** 2
    rolled_m = recording.wheels.at(recording.frame_stamps) / gain
    slip = WheelNoise(robot.slip_variance_per_m / gain**2, together, robot.track_m)
    return np.diff(rolled_m, axis=0, prepend=rolled_m[:1]), slip


def _by_first_sight(ids: Ints) -> Ints:
    """Number (K,) of each landmark in the order in which they first appear."""
    _, first, inverse = np.unique(ids, return_index=True, return_inverse=True)
    return np.asarray(np.argsort(np.argsort(first))[inverse], np.int64)
