"""Slip in bursts, in whole drives: it explains registrations that lie outside the gate."""

import numpy as np
import pytest

from estimators.laser.ekf_icp import EkfIcp
from experiments.evaluation.metrics import nees, position_errors_m, rms
from experiments.runs.experiment import Experiment
from sim.errors import InputError
from tests.estimators.landmarks.test_ekf_slam import follow
from tests.fixtures.fakes import tracking_prior

BURSTS = (
    "world=room robot=robocom sensors=lms291 sensors.laser.n_beams=91 sensors.laser.rate_hz=10 "
    "simulation.physics=kinematic simulation.rays=exact estimator=ekf_icp route.distance_m=15 "
    "robot.unmodelled_slip=0.05 robot.unmodelled_slip_m=0.3 "
    "prior.sigma_position_m=1e-3 prior.sigma_heading_rad=1e-3"
)


def test_wheels_that_slip_by_decimetres_at_once_are_explained_by_bursts():
    recording = Experiment.compose(BURSTS.split()).simulate()
    errors, consistency, bursts = [], [], []
    for options in ({}, {"slip_burst_m": 0.3}):
        keep = ("slip_burst", "status")
        found = follow(EkfIcp(**options), recording, tracking_prior(recording), keep=keep)
        truth = recording.truth_at(found.stamps)
        errors.append(rms(position_errors_m(truth, found.means)))
        consistency.append(np.mean(nees(truth, found.means, found.covariances)) / 3.0)
        bursts.append(sum(bool(b) for b in found.extras.get("slip_burst", ())))
    assert errors[1] < 0.05 * errors[0]
    assert consistency[1] < 2.0 < 100.0 < consistency[0]
    assert bursts[0] == 0 < bursts[1]


def test_bursts_need_a_gate_and_change_nothing_where_nothing_is_gated():
    with pytest.raises(InputError, match=r"set estimator\.gate_probability"):
        EkfIcp(slip_burst_m=0.1, gate_probability=None)
    steady = [word for word in BURSTS.split() if "unmodelled" not in word]
    recording = Experiment.compose([*steady, "route.distance_m=5"]).simulate()
    plain, ready = (
        follow(EkfIcp(slip_burst_m=s), recording, tracking_prior(recording), keep=())
        for s in (0.0, 0.3)
    )
    assert np.array_equal(plain.means, ready.means)
    assert np.array_equal(plain.covariances, ready.covariances)
