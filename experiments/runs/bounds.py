"""The bound of a run's recording as columns, beside the errors of its estimates.

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
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from estimators.base import Prior
from experiments.evaluation.pose_bound import Chain, PathBound, Sights, bound_path
from experiments.evaluation.sensor_information import (
    WheelNoise,
    laser_information,
    motion_terms,
    stereo_information,
)
from experiments.runs.columns import REVISED
from experiments.runs.objects import Objects
from experiments.runs.schema import is_ours
from sim.arrays import Array, Ints
from sim.recording import Recording
from sim.robot.base import robot_from_config
from sim.robot.drive import DifferentialDrive
from sim.sensors import Encoder, Laser, Sensor, StereoCamera
from sim.worlds.world import World

_NAMING = ("laser", "stereo", "robots")  # options of our methods that name a sensor


@dataclass(frozen=True)
class _Known:
    """What the bound depends on; the recording by its checksum."""

    checksum: str
    sensors: tuple[str, ...]
    start: bytes
    landmarks: bool
    recording: Recording = field(compare=False, repr=False)


def bound_columns(
    experiment: Objects, recording: Recording, prior: Prior, revised: bool, after_s: float
) -> dict[str, float]:
    """Columns `bound_rmse_m` and `bound_heading_rad`, and those of the revised path if it has one.

    Empty where there is no bound: over a recording that was not simulated, without a start, of a
    robot or a sensor of another law, with a laser but without a map, and without sensors at all.

    Parameters
    ----------
    after_s
        Frames of the first seconds do not count, as in `experiments.evaluation.metrics.score`.
    """
    names = _sensors_read(experiment, recording)
    sensors = [recording.sensors[name] for name in names]
    blind = any(isinstance(sensor, Laser) for sensor in sensors) and prior.map is None
    if blind or prior.covariance is None or not _is_known(recording, sensors):
        return {}
    start, landmarks = prior.covariance.tobytes(), isinstance(prior.map, World)
    path = _bound(_Known(recording.checksum, names, start, landmarks, recording))
    counted = recording.frame_stamps >= recording.frame_stamps[0] + after_s
    columns = _pooled("", path.online[counted])
    return columns | (_pooled(REVISED, path.revised[counted]) if revised else {})


def _pooled(prefix: str, covariances: Array) -> dict[str, float]:
    """Root mean squares over the Frames."""
    x, y, heading = np.diagonal(covariances, axis1=1, axis2=2).mean(axis=0)
    return {
        f"{prefix}bound_rmse_m": float(np.sqrt(x + y)),
        f"{prefix}bound_heading_rad": float(np.sqrt(heading)),
    }


def _sensors_read(experiment: Objects, recording: Recording) -> tuple[str, ...]:
    """Sensors that the estimator reads; all of them if its options do not say."""
    settings: Mapping[str, Any] = experiment.config["estimator"]
    given = [settings[option] for option in _NAMING if settings.get(option) is not None]
    named = given if given and is_ours(settings) else recording.sensors
    return tuple(name for name in named if not isinstance(recording.sensors[name], Encoder))


def _is_known(recording: Recording, sensors: list[Sensor]) -> bool:
    """Whether the law of the wheels and of the sensors is known, and the sensors see a world."""
    truth, made_with = recording.truth, recording.config.get("robot")
    if truth is None or truth.world is None or not len(truth.wheel_travel_m):
        return False
    ours = f"{DifferentialDrive.__module__}.{DifferentialDrive.__qualname__}"
    # a file does not choose what code runs
    if not isinstance(made_with, dict) or made_with.get("_target_", ours) != ours:
        return False
    return bool(sensors) and all(
        (isinstance(sensor, Laser) and sensor.sigma_range_m > 0.0)
        or (
            isinstance(sensor, StereoCamera)
            and min(sensor.sigma_column_px, sensor.sigma_row_px, sensor.sigma_disparity_px) > 0.0
        )
        for sensor in sensors
    )


@functools.lru_cache(maxsize=4)
def _bound(known: _Known) -> PathBound:
    """The bound over all Frames of a recording."""
    recording, truth = known.recording, known.recording.known_truth
    poses = recording.truth_at(recording.frame_stamps)
    rolled = [np.interp(recording.frame_stamps, truth.stamps, w) for w in truth.wheel_travel_m.T]
    travel_m = np.diff(rolled, axis=1, prepend=np.array(rolled)[:, :1]).T
    by_before, noise = motion_terms(poses, travel_m, _wheels(recording))
    start = np.frombuffer(known.start).reshape(3, 3)
    chain = Chain(start, by_before, noise, np.zeros_like(noise))
    for name in known.sensors:
        sensor, log = recording.sensors[name], recording.logs[name]
        rows = np.searchsorted(recording.frame_stamps, log.stamps)
        if isinstance(sensor, Laser):
            told = laser_information(recording.known_world, sensor, poses[rows], log["ranges_m"])
            np.add.at(chain.information, rows, told)
        elif isinstance(sensor, StereoCamera):
            seen = np.asarray(truth.readings[name]["true_ids"], np.int64)
            frames = np.repeat(rows, np.diff(log.known_splits))
            points = recording.known_world.landmarks[seen]
            of_pose, cross, own = stereo_information(sensor, poses[frames], points)
            np.add.at(chain.information, frames, of_pose)
            if not known.landmarks:
                sights = Sights(frames, _by_first_sight(seen), cross, own)
                chain = chain._replace(sights=sights)
    return bound_path(chain)


def _wheels(recording: Recording) -> WheelNoise:
    """How the wheels of the robot that made a recording slip."""
    robot: Any = robot_from_config(recording.config["robot"])
    gain = 1.0 + robot.slip_bias  # the encoder reads so much more than the wheel rolls
    # shared slip that lasts is not white; without it the bound is lower
    together = 0.0 if robot.forward_slip_length_m else robot.forward_slip_m / float(gain.max()) ** 2
    return WheelNoise(robot.slip_variance_per_m / gain**2, together, robot.track_m)


def _by_first_sight(ids: Ints) -> Ints:
    """Number (K,) of each landmark in the order in which they first appear."""
    _, first, inverse = np.unique(ids, return_index=True, return_inverse=True)
    return np.asarray(np.argsort(np.argsort(first))[inverse], np.int64)
