"""Small recordings made by hand, without the simulator, for tests that need one.

A robot drives a circle in a square room. Wheels, laser and landmarks are worked out from plain
geometry here, so they also stand beside the simulator's as a second opinion.
"""

import dataclasses
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from estimators.base import Estimate, Prior
from estimators.peers import MissingPackageError
from experiments.papers.maximo2024.places import UMH, place_world
from sim import se2
from sim.errors import InputError
from sim.recording import Frame, Log, Recording, Truth, WheelLog
from sim.robot import RobotGeometry
from sim.sensors import Encoder, Laser, Mount, StereoCamera
from sim.world import World

ROBOT = RobotGeometry(wheel_radius_m=0.05, track_m=0.19)
HALF_ROOM_M = 4.0


EXAMPLES = Path(__file__).resolve().parent.parent / "docs/examples"
# Overrides of the options that run a program
PROGRAMS = {
    "external": [f"estimator.command=['{sys.executable}','{EXAMPLES}/external_odometry.py']"],
    "offline": [f"estimator.command='sh {EXAMPLES}/offline_odometry.sh {{log}} {{start}} {{out}}'"],
}


@contextmanager
def peers_may_be_missing():
    """Skip the test, with the reason, where a peer's package or program is not installed."""
    try:
        yield
    except InputError as error:
        if isinstance(error, MissingPackageError) or "no program build/peers/" in str(error):
            pytest.skip(str(error))
        raise


def square_room(n_landmarks=40, seed=0):
    """A room of 8 x 8 m about the origin, with landmarks on its walls."""
    h = HALF_ROOM_M
    corners = np.array([[-h, -h], [h, -h], [h, h], [-h, h]])
    walls = np.hstack([corners, np.roll(corners, -1, axis=0)])
    rng = np.random.default_rng(seed)
    side, along = rng.integers(4, size=n_landmarks), rng.random((n_landmarks, 1))
    feet = walls[side, :2] + along * (walls[side, 2:] - walls[side, :2])
    landmarks = np.column_stack([feet, rng.uniform(0.2, 1.5, n_landmarks)])
    return World("square", walls, np.tile([0.0, 2.5], (4, 1)), landmarks=landmarks)


def circle(
    seed=0,
    *,
    n_frames=100,
    rate_hz=10.0,
    radius_m=1.5,
    speed_mps=0.3,
    start=(0.5, -1.0, 0.4),
    kr=1e-5,
    kl=1e-5,
    n_beams=181,
    sigma_range_m=0.01,
    identifies=True,
):
    """A counter-clockwise circle; every Frame has a scan, every other one an image.

    The encoders err by the k |ds| law at each Frame. All in one square room with finite ranges.
    """
    rng = np.random.default_rng(seed)
    world = square_room()
    stamps = np.arange(n_frames) / rate_hz
    turn = speed_mps / radius_m * stamps
    motion = np.column_stack([radius_m * np.sin(turn), radius_m * (1.0 - np.cos(turn)), turn])
    poses = se2.compose(np.asarray(start, float), motion)
    half = ROBOT.track_m / 2.0
    travel = turn[:, None] * np.array([radius_m + half, radius_m - half])
    steps = np.diff(travel, axis=0, prepend=travel[:1])
    errors = np.sqrt(np.abs(steps) * [kr, kl]) * rng.standard_normal(steps.shape)
    laser = Laser(rate_hz, n_beams, sigma_range_m=sigma_range_m, mount=Mount())
    camera = StereoCamera(rate_hz=rate_hz / 2, identifies=identifies)
    images = [_image(camera, pose, world.landmarks, rng) for pose in poses[::2]]
    points = np.concatenate([p for p, _ in images])
    ids = np.concatenate([i for _, i in images])
    return Recording(
        frame_stamps=stamps,
        wheels=WheelLog(stamps, np.cumsum(steps + errors, axis=0)),
        robot=ROBOT,
        sensors={"encoder": Encoder(rate_hz), "laser": laser, "stereo": camera},
        logs={
            "laser": Log.of(
                laser, stamps, ranges_m=laser.measure(room_ranges_m(laser, poses), rng)
            ),
            "stereo": Log.of(
                camera,
                stamps[::2],
                np.cumsum([0, *(len(i) for _, i in images)]),
                points_in_camera=points,
                descriptors=np.zeros((len(points), 0)),
                **({"ids": ids} if identifies else {}),
            ),
        },
        truth=Truth(stamps, poses, travel, {"stereo": {"true_ids": ids}}, world),
        config={"fake": "circle", "seed": seed},
    )


def room_ranges_m(laser, poses):
    """Ranges (T, beams) to the walls of the square room: the nearest of two crossings a beam."""
    poses = np.asarray(poses, float)
    angles = poses[:, 2:] + laser.bearings_rad
    with np.errstate(divide="ignore"):
        by_x = (np.copysign(HALF_ROOM_M, np.cos(angles)) - poses[:, :1]) / np.cos(angles)
        by_y = (np.copysign(HALF_ROOM_M, np.sin(angles)) - poses[:, 1:2]) / np.sin(angles)
    return np.minimum(by_x, by_y)


def _image(camera, pose, landmarks, rng):
    """Noisy points in the camera and ids of the landmarks in view."""
    ahead = se2.transform(se2.inverse(pose), landmarks[:, :2])
    points = np.column_stack([-ahead[:, 1], camera.mount.z_m - landmarks[:, 2], ahead[:, 0]])
    z = points[:, 2]
    inside = (z > 0.1) & (np.linalg.norm(points, axis=1) < camera.max_distance_m)
    inside &= np.abs(points[:, 0]) < z * np.tan(camera.fov_horizontal_rad / 2)
    inside &= np.abs(points[:, 1]) < z * np.tan(camera.fov_vertical_rad / 2)
    return camera.measure(points[inside], rng), np.flatnonzero(inside)


def scan_frame(stamp, duration_s, wheel_increments_m, ranges_m):
    """A Frame with a laser scan."""
    reading = {"laser": {"ranges_m": np.asarray(ranges_m, np.float32)}}
    return Frame(stamp, duration_s, wheel_increments_m, reading)


def with_reading(frame, name, **fields):
    """The Frame with another reading of a sensor."""
    return dataclasses.replace(frame, readings={**frame.readings, name: fields})


def with_scan(frame, ranges_m):
    """The Frame with another laser scan."""
    return with_reading(frame, "laser", ranges_m=np.asarray(ranges_m, np.float32))


def blind(frame):
    """The Frame without readings: the wheels alone."""
    return dataclasses.replace(frame, readings={})


def with_field(recording, name, splits=None, **values):
    """The recording with other values of a sensor's fields, and other splits if they are given."""
    log = recording.log(name)
    splits = log.splits if splits is None else splits
    other = dataclasses.replace(log, splits=splits, values={**log.values, **values})
    other.check(name)
    return recording.with_log(name, other)


def with_descriptors(recording, descriptors):
    """The recording with descriptors (K, D) of all its landmark observations."""
    return with_field(recording, "stereo", descriptors=np.asarray(descriptors, np.float32))


def true_ids(recording):
    """True landmark (K,) of each observation."""
    return recording.truth.readings["stereo"]["true_ids"]


def tracking_prior(recording, sigma=(0.02, 0.02, 0.01), with_map=True):
    """The true start with a given spread."""
    return Prior(
        recording.robot,
        recording.sensors,
        recording.truth.poses[0].copy(),
        np.diag(np.square(sigma)),
        recording.truth.world if with_map else None,
    )


def estimate(recording, means=None, covariances=None):
    """An Estimate at the Frame stamps: by default the truth, with unit covariances."""
    stamps = recording.frame_stamps
    means = recording.truth_at(stamps) if means is None else np.asarray(means, float)
    if covariances is None:
        covariances = np.tile(np.eye(3), (len(stamps), 1, 1))
    return Estimate(stamps.copy(), means, covariances, step_seconds=np.full(len(stamps), 1e-5))


def place_route():
    """A short route with clear places, and a tracking prior with its map."""
    world = place_world(dataclasses.replace(UMH, n_nodes=40, noise_weight=0.3), 0)
    recording = world.recording
    start = recording.truth_at(recording.frame_stamps[:1])[0]
    spread = np.diag(np.square([0.5, 0.5, 0.1]))
    return recording, Prior(recording.robot, recording.sensors, start, spread, world.known_map)


def outline(points, n=16):
    """Descriptor (n,) of a cloud (P, 3): its points' mean distance by bearing."""
    sector = ((np.arctan2(points[:, 1], points[:, 0]) / np.pi + 1.0) * n / 2).astype(int) % n
    sums = np.bincount(sector, np.hypot(points[:, 0], points[:, 1]), minlength=n)
    return sums / np.maximum(np.bincount(sector, minlength=n), 1)


class Outline:
    """The same as an object."""

    def __init__(self, n):
        self.n = n

    def __call__(self, points):
        return outline(points, self.n)
