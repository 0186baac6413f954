"""Slip that the believed noise does not describe, in whole drives: two scans outvote the wheels."""

import numpy as np
import pytest

from estimators.laser.ekf_icp import EkfIcp
from experiments.evaluation.metrics import nees, position_errors_m, rms
from experiments.runs.experiment import Experiment
from tests.estimators.landmarks.test_ekf_slam import follow
from tests.fixtures.fakes import tracking_prior

STEADY = (
    "world=room robot=robocom sensors=lms291 sensors.laser.n_beams=91 sensors.laser.rate_hz=10 "
    "simulation.physics=kinematic simulation.rays=exact estimator=ekf_icp route.distance_m=15 "
    "prior.sigma_position_m=1e-3 prior.sigma_heading_rad=1e-3"
)
BURSTS = STEADY + " robot.unmodelled_slip=0.05 robot.unmodelled_slip_m=0.3"


class Blind(EkfIcp):
    """The filter without witnesses: a registration outside the gate is dropped."""

    def _witnessed(self, *_):
        return False


def simulated(words):
    return Experiment.compose(words.split()).simulate()


def found(estimator, recording):
    """RMS error in m, NEES per degree of freedom, and registrations explained by slip."""
    keep = ("slip_burst", "status")
    path = follow(estimator, recording, tracking_prior(recording), keep=keep)
    truth = recording.truth_at(path.stamps)
    consistency = np.mean(nees(truth, path.means, path.covariances)) / 3.0
    error_m = rms(position_errors_m(truth, path.means))
    return error_m, consistency, sum(bool(b) for b in path.extras.get("slip_burst", ()))


def test_wheels_that_slip_by_decimetres_at_once_are_outvoted():
    recording = simulated(BURSTS)
    error_m, consistency, bursts = found(EkfIcp(), recording)
    blind_m, blind_consistency, none = found(Blind(), recording)
    assert error_m < 0.05 * blind_m
    assert consistency < 2.0 < 100.0 < blind_consistency
    assert none == 0 < bursts


@pytest.mark.slow
@pytest.mark.parametrize("world", ["room", "curved"])
def test_wheels_believed_far_too_good_are_outvoted(world):
    recording = simulated(f"{STEADY} robot.kr=1e-4 robot.kl=1e-4 world={world}")
    informed_m, *_ = found(EkfIcp(kr=1e-4, kl=1e-4), recording)
    told_m, consistency, bursts = found(EkfIcp(kr=2e-6, kl=2e-6), recording)
    blind_m, *_ = found(Blind(kr=2e-6, kl=2e-6), recording)
    assert told_m < 3.0 * informed_m < blind_m
    assert consistency < 3.0
    assert bursts


def test_witnesses_change_nothing_where_nothing_is_gated():
    recording = simulated(STEADY)
    plain, ready = (
        follow(estimator, recording, tracking_prior(recording), keep=())
        for estimator in (Blind(), EkfIcp())
    )
    assert np.array_equal(plain.means, ready.means)
    assert np.array_equal(plain.covariances, ready.covariances)
