"""Gains and track as states: their derivatives, and wheels that are not what is said of them."""

import dataclasses

import numpy as np
import pytest

from estimators.landmarks.ekf_slam import EkfSlam
from estimators.wheels import NO_MOTION, WheelOptions, WheelPrediction, gained_motion
from experiments.evaluation.metrics import nees, position_errors_m, rms
from experiments.gate.conform import check_estimator
from experiments.runs.experiment import Experiment
from sim import se2
from sim.errors import InputError
from sim.recording import Frame
from sim.robot.drive import RobotGeometry
from tests.estimators.landmarks.test_ekf_slam import follow
from tests.fixtures.derivatives import slope
from tests.fixtures.fakes import tracking_prior

GAINS = np.array([0.04, -0.03, 0.05])
INCREMENTS_M = np.array([[0.05, 0.08], [-0.02, 0.03], [0.04, 0.04], [0.1, -0.06]])
DRIVE = (
    "world=room world.n_landmarks=30 robot=robocom sensors=stereo_pixel "
    "sensors.stereo.max_distance_m=3 simulation.physics=kinematic route.distance_m=40"
)


def motion_by(gains):
    wheels = WheelPrediction(WheelOptions(), 0.3)
    motion = NO_MOTION
    for i, increments in enumerate(INCREMENTS_M):
        motion = motion.then(gained_motion(wheels, Frame(float(i), 1.0, increments), gains, 0.3))
    return motion


def test_the_derivative_is_that_of_differences():
    expected = slope(lambda gains: motion_by(gains).motion.mean, GAINS)
    assert np.allclose(motion_by(GAINS).by_gains, expected, atol=1e-8)


def test_the_joint_covariance_is_that_of_the_whole_jacobian():
    rng = np.random.default_rng(0)
    root = 0.1 * rng.standard_normal((9, 9))
    P, pose, motion = root @ root.T, np.array([1.0, 2.0, 0.4]), motion_by(GAINS)

    def moved(state):
        mean = se2.compose(state[:3], motion_by(state[3:6]).motion.mean)
        return np.append(mean, state[3:])

    F = slope(moved, np.concatenate([pose, GAINS, np.zeros(3)]))
    by_motion = slope(lambda u: se2.compose(pose, u), motion.motion.mean)
    expected = F @ P @ F.T
    expected[:3, :3] += by_motion @ motion.motion.covariance @ by_motion.T
    mean = motion.apply(pose, P, slice(0, 3), slice(3, 6))
    assert np.allclose(mean, moved(np.concatenate([pose, GAINS, np.zeros(3)]))[:3])
    assert np.allclose(P, expected, atol=1e-8)


@pytest.fixture(scope="module")
def recording():
    """Wheels that log 4 % too little and 3 % too much, on a track stated 5 % too short."""
    biased = "robot.bias_right=-0.04 robot.bias_left=0.03"
    made = Experiment.compose([*DRIVE.split(), *biased.split()]).simulate()
    stated = RobotGeometry(made.robot.wheel_radius_m, made.robot.track_m / 1.05)
    return dataclasses.replace(made, robot=stated)


def run_with(recording, **options):
    slip = {"kr": 5e-5, "kl": 5e-5}
    keep = ("wheel_gains",) if options else ()
    return follow(EkfSlam(**slip, **options), recording, tracking_prior(recording), keep=keep)


def off_of(recording, found):
    truth = recording.truth_at(found.stamps)
    error = nees(truth, found.means, found.covariances)
    return rms(position_errors_m(truth, found.means)), float(np.mean(error)) / 3.0


def test_wheels_that_are_not_as_stated_are_found_out(recording):
    found = run_with(recording, gain_sigma=0.05)
    gains = found.extras["wheel_gains"][-1]
    assert gains == pytest.approx([1.0 / 0.96 - 1.0, 1.0 / 1.03 - 1.0, 0.05], abs=0.01)
    error_m, consistency = off_of(recording, found)
    believing_m, overconfident = off_of(recording, run_with(recording, errors="coordinates"))
    assert error_m < 0.3 * believing_m
    assert consistency < 3.0 < 30.0 < overconfident


@pytest.mark.slow
def test_states_of_no_deviation_are_none_and_small_ones_change_little():
    recording = Experiment.compose(DRIVE.split()).simulate()
    known, tiny = run_with(recording), run_with(recording, gain_sigma=1e-9)
    assert np.allclose(known.means, tiny.means, atol=1e-6)
    assert np.allclose(known.covariances, tiny.covariances, atol=1e-9)
    wandering = run_with(recording, gain_sigma=0.02, gain_wander_m=1e-5)
    assert all(
        check.passed
        for check in check_estimator(
            lambda: EkfSlam(gain_sigma=0.02), recording, tracking_prior(recording)
        )
    )
    assert off_of(recording, wandering)[0] < 2.0 * off_of(recording, known)[0]


def test_what_has_no_effect_is_refused():
    with pytest.raises(InputError, match="gain_wander_m has no effect"):
        EkfSlam(gain_wander_m=1e-4)
    with pytest.raises(InputError, match=r"below 0\.5, got 0\.7"):
        EkfSlam(gain_sigma=0.7)
