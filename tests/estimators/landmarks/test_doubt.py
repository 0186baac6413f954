"""A gated filter that a turn unseen by the wheels has locked out places itself again."""

import dataclasses
import functools

import numpy as np
import pytest

from estimators.landmarks.doubt import Doubt
from estimators.landmarks.ekf_slam import EkfSlam
from experiments.evaluation.metrics import position_errors_m
from experiments.runs.experiment import Experiment
from sim import se2
from sim.recording import WheelLog
from tests.estimators.landmarks.test_ekf_slam import follow

BLIND_S, TURN_RAD, RECOVERED_M, WITHIN_S = 25.0, np.radians(40.0), 1.0, 20.0
DRIVE = (
    *("world=rooms", "sensors=laser_stereo", "sensors.laser=null", "robot=robocom"),
    *("simulation.physics=kinematic", "route.distance_m=50", "estimator=ekf_slam"),
)


@functools.cache
def driven(seed):
    """A drive of which the camera sees nothing for a while, and whose wheels then turn by more."""
    experiment = Experiment.compose([*DRIVE, f"seed={seed}"])
    recording = experiment.simulate()
    begin_s = recording.frame_stamps[0] + 0.5 * recording.duration_s
    wheels, log = recording.wheels, recording.log("stereo")
    turned = np.clip((wheels.stamps - begin_s) / BLIND_S, 0.0, 1.0) * TURN_RAD
    apart_m = turned[:, None] * recording.robot.track_m / 2.0 * [1.0, -1.0]
    seeing = (log.stamps < begin_s) | (log.stamps > begin_s + BLIND_S)
    rows = np.repeat(seeing, np.diff(log.known_splits))
    splits = np.append(0, np.cumsum(np.diff(log.known_splits) * seeing))
    values = {name: array[rows] for name, array in log.values.items()}
    hidden = recording.truth.readings["stereo"]
    hidden = {name: array[rows] for name, array in hidden.items()}
    planted = dataclasses.replace(
        recording.with_log("stereo", dataclasses.replace(log, values=values, splits=splits)),
        wheels=WheelLog(wheels.stamps, wheels.position_m + apart_m),
        truth=dataclasses.replace(recording.truth, readings={"stereo": hidden}),
    )
    return planted, experiment.prior(planted), begin_s + BLIND_S


def worst_error_m(seed, **options):
    """Largest position error from twenty seconds after the camera sees again."""
    planted, prior, seen_s = driven(seed)
    slip = planted.config["robot"]["kr"]
    filter_ = EkfSlam(kr=slip, kl=slip, gate_probability=1e-6, **options)
    path = follow(filter_, planted, prior)
    late = path.stamps > seen_s + WITHIN_S
    return position_errors_m(planted.truth_at(path.stamps), path.means)[late].max()


def test_without_doubt_it_stays_lost():
    assert worst_error_m(1000, doubt_sightings=0) > 2.0 * RECOVERED_M


@pytest.mark.parametrize("errors", ["coordinates", "invariant"])
def test_a_blind_turn_is_recovered(errors):
    assert worst_error_m(1000, errors=errors) < RECOVERED_M


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1001, 1041))
def test_forty_blind_turns_are_recovered(seed):
    assert worst_error_m(seed, errors="invariant") < RECOVERED_M


LANDMARKS = np.array([[4.0, 0.0], [4.0, 3.0], [6.0, -2.0], [1.0, 5.0]])
POSE = np.array([1.0, -1.0, 0.7])


def seen_from(pose, slots, rng):
    seen = se2.transform(se2.inverse(pose), LANDMARKS[slots])
    return seen + 0.02 * rng.standard_normal(seen.shape)


def test_the_pose_is_that_on_which_sightings_agree():
    rng, doubt = np.random.default_rng(0), Doubt(10)
    slots = np.array([0, 1, 2, 3, 0, 1, 2, 0])
    doubt.note(slots, seen_from(POSE, slots, rng), np.zeros(8, bool))
    assert doubt.rises
    assert doubt.resolve(LANDMARKS) is None  # too few
    moved = np.array([0.5, 0.1, -0.3])
    doubt.move(moved)
    here = se2.compose(POSE, moved)
    doubt.note(slots[:4], seen_from(here, slots[:4], rng), np.zeros(4, bool))
    np.testing.assert_allclose(doubt.resolve(LANDMARKS), here, atol=0.05)
    doubt.note(slots[:5], seen_from(here, slots[:5], rng), np.ones(5, bool))
    assert doubt.resolve(LANDMARKS) is None
    assert not doubt.rises


def test_misread_ids_agree_on_no_pose():
    rng, doubt = np.random.default_rng(0), Doubt(10)
    for _ in range(3):
        slots = rng.integers(4, size=10)
        doubt.note((slots + rng.integers(1, 4, 10)) % 4, seen_from(POSE, slots, rng), slots < 0)
        assert doubt.resolve(LANDMARKS) is None


def test_zero_is_never():
    rng, doubt = np.random.default_rng(0), Doubt(0)
    slots = np.arange(4).repeat(5)
    doubt.note(slots, seen_from(POSE, slots, rng), np.zeros(20, bool))
    assert not doubt.rises
    assert doubt.resolve(LANDMARKS) is None
