"""Estimators at their limits: far from the origin, too much to hold, scans that are not whole."""

import dataclasses

import numpy as np
import pytest

from estimators.base import Prior, run
from estimators.graph.fixed_lag import FixedLag
from estimators.graph.smoother import Smoother
from estimators.landmarks import ekf_slam
from estimators.landmarks.ekf_slam import EkfSlam
from estimators.landmarks.fastslam import FastSLAM
from estimators.laser.ekf_icp import EkfIcp
from estimators.laser.icp_odometry import IcpOdometry
from estimators.laser.scan_lines import prepare
from estimators.on_a_map.likelihood_field import FieldOptions, beam_ends, likelihood_field
from experiments.runs.experiment import Experiment
from sim.errors import InputError
from sim.sensors import Laser
from tests.fixtures import fakes


@pytest.fixture(scope="module")
def recording():
    return fakes.circle(n_frames=12)


def at(recording, offset_m):
    """The prior and its start, so far from the origin in both directions."""
    prior = fakes.tracking_prior(recording)
    return dataclasses.replace(prior, mean=prior.mean + np.array([offset_m, offset_m, 0.0]))


@pytest.mark.parametrize("estimator", [EkfIcp, IcpOdometry])
@pytest.mark.parametrize("offset_m", [5e6, 1e9])
def test_far_from_the_origin_the_errors_are_the_same(recording, estimator, offset_m):
    near, far = (
        run(estimator(), recording, at(recording, offset), np.random.default_rng(0))
        for offset in (0.0, offset_m)
    )
    assert far.status == near.status == "ok"
    np.testing.assert_allclose(far.means - [offset_m, offset_m, 0], near.means, atol=2e-16 * 1e9)
    np.testing.assert_allclose(far.covariances, near.covariances, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("association", ["known", "mahalanobis"])
def test_a_full_map_takes_no_more_landmarks(recording, association, monkeypatch):
    monkeypatch.setattr(ekf_slam, "_MOST_LANDMARKS", 30)
    monkeypatch.setattr(ekf_slam, "_MOST_OBSERVATIONS", 20)
    rng = np.random.default_rng(0)
    estimator = EkfSlam(association=association)
    estimator.reset(fakes.tracking_prior(recording), rng)
    statuses, counts = [], []
    for k, frame in enumerate(list(recording.frames())[:5]):
        n = (15, 12, 25, 10, 10)[k]
        image = {
            "points_in_camera": rng.uniform([-3, -1, 1], [3, 1, 8], (n, 3)),
            "ids": np.arange(n) + 100 * min(k, 3),  # the last image shows what the one before did
            "descriptors": np.zeros((n, 0), np.float32),
        }
        belief = estimator.step(fakes.with_reading(frame, "stereo", **image))
        assert np.isfinite(belief.mean).all()
        assert len(belief.extras["associations"]) == n
        statuses.append(belief.extras.get("status", "ok"))
        counts.append(len(estimator.map["landmarks"]))
        assert len(estimator.map["origins"]) == counts[-1] <= 30
        if association == "known":
            assert len(estimator.map["ids"]) == counts[-1]
    assert len(estimator._state._room) <= 3 + 3 * 30
    assert statuses[0] == "ok"
    if association == "known":
        assert counts == [15, 27, 30, 30, 30]
        assert statuses[2:] == ["map full: landmarks beyond 30 rejected"] * 3
        assert (belief.extras["associations"] == -1).all()


def test_a_scan_must_have_the_lasers_number_of_ranges():
    laser = Laser(n_beams=721)
    for n in (0, 100, 720, 722):
        with pytest.raises(InputError, match=f"a scan of {n} ranges from a laser of 721 beams"):
            beam_ends(np.ones(n), laser, 60)


def test_beams_without_a_reading_leave_the_others():
    laser = Laser(n_beams=180)
    usual = beam_ends(np.full(180, 2.0), laser, 60)
    for missing in (slice(0, None, 2), slice(1, None, 2), slice(0, 90), slice(20, None)):
        for filler in (np.nan, np.inf, laser.max_range_m):
            ranges = np.full(180, 2.0)
            ranges[missing] = filler
            ends = beam_ends(ranges, laser, 60)
            assert 0 < ends.shape[1] <= usual.shape[1]
            np.testing.assert_allclose(np.hypot(ends[0], ends[1]), 2.0, rtol=1e-6)
            if np.isnan(filler):
                assert ends.shape[1] == min(60, np.isfinite(ranges).sum())
    assert beam_ends(np.full(180, np.nan), laser, 60).shape == (2, 0)


@pytest.mark.parametrize("most_m", [8.183, 81.83, 80.0, 30.1])
def test_a_range_at_the_maximum_is_no_return(most_m):
    laser = Laser(n_beams=5, max_range_m=most_m)
    ranges = np.array([most_m, 1.0, np.nextafter(np.float32(most_m), 9e9), 2.0, np.inf], np.float32)
    scan = prepare(ranges, laser.bearings_rad, laser.max_range_m)
    assert scan.beams.tolist() == [1, 3]
    assert laser.returned(ranges).tolist() == [False, True, False, True, False]
    assert beam_ends(ranges, laser, 5).shape == (2, 2)


def test_a_start_without_a_true_pose_is_refused(recording):
    truth = recording.truth
    shown = dataclasses.replace(truth, stamps=truth.stamps[3:], poses=truth.poses[3:])
    late = dataclasses.replace(recording, truth=shown)
    begin = f"{truth.stamps[3]:.2f}"
    with pytest.raises(InputError, match=rf"truth spans {begin} to .*prior\.start=global"):
        Experiment.compose().prior(late)
    assert Experiment.compose(["prior.start=global"]).prior(late).mean is None
    assert np.isfinite(Experiment.compose().prior(recording).mean).all()


def test_poses_that_are_not_finite_do_not_reach_compiled_code(recording):
    prior = fakes.tracking_prior(recording)
    for poor in ({"mean": prior.mean * np.nan}, {"covariance": np.full((3, 3), np.inf)}):
        with pytest.raises(InputError, match=f"the {next(iter(poor))} of the prior"):
            dataclasses.replace(prior, **poor)
    assert Prior(prior.robot).mean is None
    field = likelihood_field(prior.map, recording.sensors["laser"], FieldOptions())
    with pytest.raises(FloatingPointError, match="not finite"):
        field.log_likelihood(np.array([[0.0, np.nan, 0.0]]), np.ones((2, 4), np.float32))


@pytest.mark.parametrize("estimator", [EkfSlam, FastSLAM, Smoother, FixedLag])
@pytest.mark.parametrize("poor", [np.nan, np.inf, 1e300, 0.0, "duplicate"])
def test_every_landmark_method_tells_what_it_rejects(recording, estimator, poor):
    log = recording.log("stereo")
    points, ids = log["points_in_camera"].copy(), log["ids"].copy()
    if poor == "duplicate":
        ids[1], word = ids[0], "duplicate id rejected"
    else:
        points[0], word = poor, "observation without depth rejected"
    odd = fakes.with_field(recording, "stereo", points_in_camera=points, ids=ids)
    prior = fakes.tracking_prior(recording)
    found = [run(estimator(), r, prior, np.random.default_rng(0)) for r in (odd, recording)]
    assert found[0].status.startswith(word)
    assert found[1].status == "ok"
    assert np.isfinite(found[0].means).all()
