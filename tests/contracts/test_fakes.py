"""The hand-made recordings agree with the simulator's own geometry."""

import numpy as np

from sim import se2
from sim.robot.arc import arc_increment
from sim.sensors.casting import SegmentCaster
from sim.sensors.stereo import points_in_camera
from tests.fixtures import fakes


def test_scans_are_those_of_the_caster():
    recording = fakes.circle(sigma_range_m=0.0)
    laser, poses = recording.sensors["laser"], recording.truth.poses
    caster = SegmentCaster(recording.truth.world, laser)
    expected = caster.cast_many(np.array([laser.mount.in_map(pose) for pose in poses]))
    assert np.isfinite(recording.log("laser")["ranges_m"]).all()
    assert np.allclose(recording.log("laser")["ranges_m"], expected, atol=1e-5)


def test_landmarks_and_wheels_are_those_of_the_simulator():
    recording = fakes.circle(n_frames=60)
    truth, log = recording.truth, recording.log("stereo")
    camera, world = recording.sensors["stereo"], truth.world
    rows = np.searchsorted(log.splits, np.arange(len(log["ids"])), side="right") - 1
    exact = [
        points_in_camera(camera, truth.poses[2 * row], world.landmarks[[i]])[0]
        for row, i in zip(rows, log["ids"], strict=True)
    ]
    error = log["points_in_camera"] - exact
    chi2 = np.einsum("ni,nij,nj->n", error, np.linalg.inv(camera.covariance(exact)), error)
    assert len(chi2) > 100
    assert 2.5 < np.median(chi2) / 2.366 * 3 < 3.6
    steps = arc_increment(np.diff(truth.wheel_travel_m, axis=0), recording.robot.track_m)
    assert np.allclose(se2.between(truth.poses[:-1], truth.poses[1:]), steps, atol=1e-12)
