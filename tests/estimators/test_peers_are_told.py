"""Peers that read a laser believe what they are told of it, of the start and of the wheels.

Each errs least when it is told the truth, on a drive with a turned laser off the centre. One that
ignores its mount, sees half the field of view, starts elsewhere or gets the wheels late does not.
"""

import dataclasses

import numpy as np
import pytest

from estimators.base import Prior
from estimators.laser.icp_odometry import IcpOdometry
from estimators.odometry import Odometry
from experiments.gate.conform import walk
from experiments.runs.experiment import Experiment
from experiments.runs.paths import option_names
from sim import se2
from sim.recording import Log, Recording, Truth, WheelLog
from sim.sensors import Laser, Mount
from tests.fixtures import fakes

PEERS = [n for n in option_names("estimator") if n.startswith("peers/") and "gtsam" not in n]
MOUNT = {"x_m": 0.2, "y_m": -0.1, "yaw_rad": 0.6}
STANDS = 15  # Frames before it goes, so that late wheels show
SLACK_M = 0.004


def drive():
    base = fakes.circle(n_frames=80, kr=0.0, kl=0.0)
    laser = Laser(rate_hz=10.0, n_beams=241, fov_rad=4.0, sigma_range_m=1e-3, mount=Mount(**MOUNT))
    stay = np.r_[np.zeros(STANDS, int), np.arange(80)]
    stamps, poses = np.arange(len(stay)) / 10.0, base.truth.poses[stay]
    ranges_m = fakes.room_ranges_m(laser, se2.compose(poses, np.array(list(MOUNT.values()))))
    return Recording(
        frame_stamps=stamps,
        wheels=WheelLog(stamps, base.wheels.position_m[stay]),
        robot=base.robot,
        sensors={"laser": laser},
        logs={"laser": Log.of(laser, stamps, ranges_m=ranges_m.astype(np.float32))},
        truth=Truth(stamps, poses, world=base.truth.world),
    )


def told(recording, *, frames=0, start=(0.0, 0.0, 0.0), fov=1.0, **mount):
    """The recording with its wheels so many Frames late, and a prior that is wrong by this much."""
    laser = recording.sensors["laser"]
    moved = {key: MOUNT[key] + mount.get(key, 0.0) for key in MOUNT}
    laser = dataclasses.replace(laser, fov_rad=laser.fov_rad * fov, mount=Mount(**moved))
    rows = np.clip(np.arange(len(recording.frame_stamps)) - frames, 0, None)
    rows = np.minimum(rows, len(rows) - 1)
    wheels = WheelLog(recording.frame_stamps, recording.wheels.position_m[rows])
    seen = dataclasses.replace(recording, wheels=wheels, sensors={"laser": laser})
    mean = recording.truth.poses[0] + np.array(start)
    covariance = np.diag([1e-4, 1e-4, 1e-5])
    return seen, Prior(recording.robot, seen.sensors, mean, covariance, recording.truth.world)


def unfairness(make):
    """Which beliefs the errors do not follow."""
    recording = drive()

    def error_m(**wrong):
        means, _ = walk(make(), *told(recording, **wrong))
        return float(np.sqrt(np.mean((means - recording.truth.poses)[:, :2] ** 2)))

    right, found = error_m(), []
    wrong = {
        "mount": [{"yaw_rad": 0.6}, {"yaw_rad": -0.6}],
        "field of view": [{"fov": 0.5}],
        "start": [{"start": (0.6, 0.0, 0.0)}],
    }
    for name, cases in wrong.items():
        if any(error_m(**case) < right + SLACK_M for case in cases):
            found.append(name)
    if any(error_m(frames=frames) < right - SLACK_M for frames in (-1, 1)):
        found.append("wheels")
    return found


@pytest.mark.slow
@pytest.mark.parametrize("name", PEERS)
def test_peers_believe_what_they_are_told(name):
    with fakes.peers_may_be_missing():
        make = Experiment.compose([f"estimator={name}", "prior.map=world"]).estimator
        make()
        assert unfairness(make) == []


class WrongMount(IcpOdometry):
    def reset(self, prior, rng):
        laser = dataclasses.replace(prior.sensors["laser"], mount=Mount())
        super().reset(dataclasses.replace(prior, sensors={"laser": laser}), rng)


class HalfView(IcpOdometry):
    def reset(self, prior, rng):
        laser = dataclasses.replace(prior.sensors["laser"], fov_rad=2.0)
        super().reset(dataclasses.replace(prior, sensors={"laser": laser}), rng)


class OtherStart(IcpOdometry):
    def reset(self, prior, rng):
        super().reset(dataclasses.replace(prior, mean=np.zeros(3)), rng)


class StaleWheels(Odometry):
    def __init__(self):
        super().__init__(kr=1e-5, kl=1e-5)
        self._late = np.zeros(2)

    def step(self, frame):
        late, self._late = self._late, frame.wheel_increments_m
        return super().step(dataclasses.replace(frame, wheel_increments_m=late))


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (WrongMount, "mount"),
        (HalfView, "field of view"),
        (OtherStart, "start"),
        (StaleWheels, "wheels"),
    ],
)
def test_a_planted_unfairness_is_found(make, name):
    assert name in unfairness(make)


def test_ours_is_fair():
    assert unfairness(IcpOdometry) == []
