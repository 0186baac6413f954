"""What a method says of itself where its wheels stand and it rolls on."""

import dataclasses

import numpy as np
import pytest
from scipy.special import erfc

from estimators.lost import Unexplained
from experiments.runs.evaluate import run_over
from experiments.runs.experiment import Experiment
from experiments.studies.self_knowledge import planted

DRIVE = (
    "robot=robocom",
    "world=office",
    "route=tour",
    "route.distance_m=20",
    "sensors=laser_stereo",
    "sensors.laser.rate_hz=5",
    "sensors.laser.n_beams=181",
    "simulation.physics=kinematic",
    "simulation.rays=exact",
)


def test_it_is_the_share_of_the_last_five_seconds():
    unexplained, sure = Unexplained(), np.zeros((3, 3))
    assert unexplained.lost(0.0, sure) == 0.0
    unexplained.note(0.0, 1, 1)
    assert unexplained.lost(0.0, sure) == 1.0
    unexplained.note(4.0, 1, 3)
    assert unexplained.lost(4.0, sure) == pytest.approx(2 / 4)
    assert unexplained.lost(5.0, sure) == pytest.approx(1 / 3)
    assert unexplained.lost(9.0, sure) == 0.0  # nothing was read since
    for stamp_s in range(100):  # nor does it grow if nobody asks
        unexplained.note(float(stamp_s), 1, 1)
    assert len(unexplained._noted) == 5


def test_a_pose_that_is_not_known_is_lost():
    never = Unexplained()
    far = [never.lost(0.0, np.diag([s**2, 0.25 * s**2, 1.0])) for s in (0.01, 0.3, 1.0, 30.0)]
    assert far[0] == pytest.approx(0.0, abs=1e-9)
    assert far[-1] == pytest.approx(1.0, abs=1e-3)
    assert np.all(np.diff(far) > 0.0)
    # no less than that of an error along the worst direction alone
    assert far[2] > erfc(1.0 / np.sqrt(2.0))
    turned = np.array([[0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.0, 0.0, 0.0]])  # as far, at 45 degrees
    assert never.lost(0.0, turned) == pytest.approx(never.lost(0.0, np.diag([1.0, 0.0, 0.0])))


def said(one, recording):
    """All that an estimator says over a recording."""
    rng = np.random.default_rng(0)
    online, _ = run_over(recording, one.estimator(), one.prior(recording), rng, ("lost",))
    return np.array([value for value in online.extras["lost"] if value is not None])


@pytest.mark.parametrize("estimator", ["ekf_slam", "fastslam"])
def test_landmarks_deny_wheels_that_are_lifted(estimator, monkeypatch):
    monkeypatch.setattr(planted, "LIFTED", (0.4, 0.7))
    one = Experiment.compose([*DRIVE, f"estimator={estimator}", "seed=4"])
    recording = one.recording()
    quiet, lifted = said(one, recording), said(one, planted.lift_wheels(recording))
    assert len(quiet) > 10
    assert quiet.max() < 0.1
    assert lifted.max() > 0.25


@pytest.mark.parametrize("estimator", ["ekf_icp", "graph_slam"])
def test_scans_that_are_not_used(estimator):
    one = Experiment.compose([*DRIVE, f"estimator={estimator}", "seed=4", "route.distance_m=6"])
    recording = one.recording()
    log = recording.logs["laser"]
    quiet, blind = said(one, recording), log.stamps > log.stamps[-1] - 6.0
    assert len(quiet) == len(log.stamps)
    assert quiet.max() < 0.1
    rng = np.random.default_rng(0)
    elsewhere = rng.uniform(0.5, 4.0, log["ranges_m"].shape)
    cases = [(np.inf, 0.0), (elsewhere, 1.0)]  # nothing seen denies nothing
    for read, wanted in cases[: 1 + (estimator == "ekf_icp")]:  # graph_slam takes up the new scans
        ranges_m = np.where(blind[:, None], read, log["ranges_m"]).astype(log["ranges_m"].dtype)
        changed = dataclasses.replace(log, values={**log.values, "ranges_m": ranges_m})
        lost = said(one, recording.with_log("laser", changed))[-1]
        assert lost == pytest.approx(wanted, abs=1e-3)


def test_landmarks_without_ids_do_not_say():
    one = Experiment.compose(
        [*DRIVE, "route.distance_m=2", "estimator=ekf_slam", "estimator.association=mahalanobis"]
    )
    recording = one.recording()
    online, _ = run_over(
        recording, one.estimator(), one.prior(recording), np.random.default_rng(0), ("lost",)
    )
    assert not [value for value in online.extras.get("lost", []) if value is not None]
