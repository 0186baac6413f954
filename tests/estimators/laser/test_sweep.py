"""Scans that are measured while the robot moves."""

import numpy as np
import pytest

from estimators.base import run
from estimators.gaussian import Gaussian
from estimators.laser.ekf_icp import EkfIcp
from estimators.laser.sweep import at_stamp
from experiments.evaluation.metrics import nees
from experiments.evaluation.scan_bound import cast
from experiments.runs.experiment import Experiment
from sim import se2
from sim.sensors import Laser, Mount
from tests.estimators.laser.test_icp import ROOM

MOVED, IN_S = np.array([0.09, 0.002, 0.15]), 0.1


def swept(laser, stamp_pose, moved=MOVED):
    """Ranges of beams that are each cast from where the laser then is."""
    twist = se2.log(moved) / IN_S
    ranges = []
    for bearing, offset_s in zip(laser.bearings_rad, laser.beam_offsets_s, strict=True):
        pose = se2.compose(se2.compose(stamp_pose, se2.exp(offset_s * twist)), laser.mount.pose)
        ranges.append(cast(ROOM, pose, np.array([bearing]))[0][0])
    return np.array(ranges)


@pytest.mark.parametrize("fov_rad", [np.pi, 2.0 * np.pi])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_beams_are_taken_to_the_stamp(fov_rad, sign):
    laser = Laser(n_beams=361, fov_rad=fov_rad, sweep_s=0.09, mount=Mount(x_m=0.1))
    pose, moved = np.array([0.3, 0.4, 0.7]), MOVED * [1.0, 1.0, sign]
    ranges, bearings = at_stamp(swept(laser, pose, moved), laser, moved, IN_S)
    assert np.all(np.diff(bearings) > 0.0)
    seen = np.isfinite(ranges)
    assert seen.mean() > 0.9
    true = cast(ROOM, se2.compose(pose, laser.mount.pose), bearings[seen])[0]
    near = np.abs(ranges[seen] - true) < 1e-6
    assert near.mean() > 0.98  # but for what only one of both places sees, at edges


def test_a_laser_at_rest_or_without_a_sweep_keeps_its_scan():
    still = Laser(n_beams=11)
    ranges = np.linspace(1.0, 2.0, 11)
    for laser, moved in ((still, MOVED), (Laser(n_beams=11, sweep_s=0.1), np.zeros(3))):
        found, bearings = at_stamp(ranges, laser, moved, IN_S)
        np.testing.assert_allclose(found, ranges)
        np.testing.assert_allclose(bearings, laser.bearings_rad)


def test_a_turn_during_the_sweep_does_not_turn_the_motion():
    # a scan at rest, and one in a turn: without the beams' instants it errs by 0.07 rad
    laser, rng = Laser(n_beams=361, sweep_s=0.09, sigma_range_m=0.01), np.random.default_rng(0)
    start = np.array([0.3, 0.4, 0.2])
    first = cast(ROOM, start, laser.bearings_rad)[0]
    second = swept(laser, se2.compose(start, MOVED))
    matcher = EkfIcp().matcher
    scans = [
        matcher.prepare(ranges + 0.01 * rng.standard_normal(361), laser, moved, IN_S)
        for ranges, moved in ((first, np.zeros(3)), (second, MOVED))
    ]
    guess = Gaussian(MOVED, np.diag([0.02, 0.02, 0.02]) ** 2)
    found = matcher.match(scans[1], scans[0], guess, laser, rng)
    assert found.status == "ok"
    assert abs(found.motion.mean[2] - MOVED[2]) < 2e-3
    assert np.hypot(*(found.motion.mean - MOVED)[:2]) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize(("fault", "informed"), [("bias_share=0.005", 4.0), ("sweep_s=0.09", 4.0)])
def test_the_filter_knows_what_real_lasers_do_to_it(fault, informed):
    """Ranges that are all off alike, and a sweep during which the wheels slip."""
    squares = []
    for seed in (0, 1):
        experiment = Experiment.compose(
            f"world=rooms robot=robocom route.distance_m=20 seed={seed} sensors=hokuyo "
            "sensors.laser._target_=sim.sensors.real_laser.RealLaser sensors.laser.rate_hz=10 "
            f"+sensors.laser.{fault} simulation.physics=kinematic estimator=ekf_icp".split()
        )
        recording = experiment.simulate()
        prior = experiment.prior(recording)
        path = run(experiment.estimator(), recording, prior, np.random.default_rng(0))
        truth = recording.truth_at(path.stamps)
        squares.append(np.nanmean(nees(truth, path.means, path.covariances)) / 3.0)
    assert np.mean(squares) < informed, squares
