"""The fixed-lag smoother against full least squares, its covariances, and its edges."""

import dataclasses

import numpy as np
import pytest

from estimators.base import run
from estimators.graph.fixed_lag import FixedLag, _add
from estimators.graph.smoother import Smoother
from experiments.evaluation.metrics import nees
from sim import se2
from sim.errors import InputError
from sim.sensors import Mount
from sim.sensors.stereo import points_in_camera
from tests.fixtures.fakes import circle, tracking_prior, with_field

WHEELS = {"kr": 1e-4, "kl": 1e-4}


def follow(estimator, recording, prior=None):
    prior = prior or tracking_prior(recording)
    return run(estimator, recording, prior, np.random.default_rng(0), keep=("status",))


def least_squares_online(recording, prior=None):
    """Means and covariances of the newest pose, full least squares at every image."""
    batch = Smoother(**WHEELS)
    batch.reset(prior or tracking_prior(recording), np.random.default_rng(0))
    rows, means, covariances = [], [], []
    for row, frame in enumerate(recording.frames()):
        batch.step(frame)
        if "stereo" in frame.readings and row:
            revised = batch.finish()
            rows.append(row)
            means.append(revised.means[-1])
            covariances.append(revised.covariances[-1])
    return rows, np.array(means), np.array(covariances)


def off(means, others, covariances):
    """Greatest difference of poses (T, 3), in standard deviations."""
    apart = means - others
    apart[:, 2] = se2.wrap(apart[:, 2])
    return np.abs(apart / np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))).max()


@pytest.mark.parametrize("correlated", [True, False])
def test_a_window_beyond_the_run_is_full_least_squares(correlated):
    recording = circle(0, n_frames=40, kr=1e-4, kl=1e-4)
    mount = Mount(x_m=0.15, y_m=-0.05, z_m=0.4, yaw_rad=0.2)
    camera = dataclasses.replace(
        recording.sensors["stereo"], mount=mount, correlated=correlated, sigma_disparity_px=0.2
    )
    sensors = {**recording.sensors, "stereo": camera}
    prior = dataclasses.replace(tracking_prior(recording), sensors=sensors)
    alike = FixedLag(**WHEELS, lag_images=1000, iterations=6, robust="none")
    online = follow(alike, recording, prior)
    rows, means, covariances = least_squares_online(recording, prior)
    assert off(online.means[rows], means, covariances) < 0.01
    scale = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    scale = scale[:, :, None] * scale[:, None, :]
    np.testing.assert_allclose(online.covariances[rows] / scale, covariances / scale, atol=0.01)


@pytest.mark.parametrize(
    "lag_images", [1, *(pytest.param(n, marks=pytest.mark.slow) for n in (3, 8))]
)
def test_what_leaves_the_window_is_kept(lag_images):
    """With hardly any noise all is linear, and any window gives what full least squares does.

    The circle closes, so landmarks come back long after their last image has left the window.
    """
    share = 1e-3  # of the noise that is believed
    recording = circle(1, n_frames=340, kr=share**2 * 1e-4, kl=share**2 * 1e-4)
    log, camera = recording.log("stereo"), recording.sensors["stereo"]
    poses = np.repeat(recording.truth.poses[::2], np.diff(log.splits), axis=0)
    landmarks = recording.truth.world.landmarks[log["ids"]]
    exact = np.array(
        [points_in_camera(camera, p, m[None])[0] for p, m in zip(poses, landmarks, strict=True)]
    )
    points = exact + share * (log["points_in_camera"] - exact)
    recording = with_field(recording, "stereo", points_in_camera=points)
    kept, batch = FixedLag(**WHEELS, lag_images=lag_images), Smoother(**WHEELS)
    online = follow(kept, recording)
    follow(batch, recording)
    revised, last = batch.finish(), slice(338, 339)  # a Frame with an image
    assert off(online.means[last], revised.means[last], revised.covariances[last]) < 0.02 * share
    scale = np.sqrt(np.diag(revised.covariances[338]))
    scale = np.outer(scale, scale)
    apart = (online.covariances[338] - revised.covariances[338]) / scale
    assert np.abs(apart).max() < 0.002
    assert len(kept._images) == lag_images - 1


@pytest.mark.slow
def test_a_landmark_counts_again_unless_it_is_forgotten():
    """Both are the same until a landmark comes back that the window does not see any more."""
    recording, lag = circle(1, n_frames=400, kr=1e-4, kl=1e-4), 8
    forgetful = FixedLag(**WHEELS, lag_images=lag, keep_landmarks=False)
    short = follow(forgetful, recording)
    long = follow(FixedLag(**WHEELS, lag_images=lag), recording)
    last_image, back = {}, None
    for row, frame in enumerate(recording.frames()):
        if "stereo" in frame.readings and back is None:
            ids = frame.readings["stereo"]["ids"].tolist()
            if any(row // 2 - last_image.get(i, row // 2) > lag for i in ids):
                back = row
            last_image |= dict.fromkeys(ids, row // 2)
    assert 20 < back < 390
    np.testing.assert_allclose(short.means[:back], long.means[:back], atol=1e-9)
    np.testing.assert_allclose(short.covariances[:back], long.covariances[:back], atol=1e-12)
    assert np.trace(short.covariances[-1]) > 1.1 * np.trace(long.covariances[-1])
    seen = np.unique(np.concatenate([image.landmarks for image in forgetful._images]))
    np.testing.assert_array_equal(seen, np.arange(len(forgetful._landmarks)))


@pytest.mark.slow
def test_errors_are_within_their_covariances():
    """In the middle and at the end of many recordings."""
    squares = []
    for seed in range(25):
        recording = circle(seed, n_frames=80, kr=1e-4, kl=1e-4)
        prior = tracking_prior(recording)
        start = np.random.default_rng([seed, 1]).multivariate_normal(prior.mean, prior.covariance)
        prior = dataclasses.replace(prior, mean=start)
        online = follow(FixedLag(**WHEELS, lag_images=10), recording, prior)
        truth = recording.truth.poses
        squares.append(nees(truth, online.means, online.covariances)[[11, 40, 79]])
    assert 0.7 < np.mean(squares) / 3.0 < 1.35


@pytest.mark.slow
def test_it_is_close_to_full_least_squares():
    """Errors over the whole run, of six recordings together."""
    mine, best = [], []
    for seed in range(6):
        recording = circle(seed, n_frames=70, kr=1e-4, kl=1e-4)
        online = follow(FixedLag(**WHEELS), recording)
        rows, means, _ = least_squares_online(recording)
        truth = recording.truth.poses[rows]
        mine.append(online.means[rows] - truth)
        best.append(means - truth)
    ratio = np.linalg.norm(np.array(mine)[..., :2]) / np.linalg.norm(np.array(best)[..., :2])
    assert ratio < 1.05


@pytest.mark.parametrize("lag_images", [1, 6])
def test_seeing_landmarks_again_does_not_tell_where_north_is(lag_images, monkeypatch):
    """Nothing may lower the uncertainty of the whole map's heading, given at the start."""

    def min_share_of_spread():
        sigmas, spread = [], 0.3
        for seed in range(3):
            recording = circle(seed, n_frames=120, kr=1e-3, kl=1e-3)
            prior = tracking_prior(recording, sigma=(0.02, 0.02, spread))
            turned = dataclasses.replace(prior, mean=prior.mean + np.array([0, 0, spread]))
            online = follow(FixedLag(kr=1e-3, kl=1e-3, lag_images=lag_images), recording, turned)
            sigmas.append(np.sqrt(online.covariances[:, 2, 2].min()) / spread)
        return min(sigmas)

    assert min_share_of_spread() > 0.995
    monkeypatch.setattr(FixedLag, "_linearise_again", lambda *_: None)  # planted
    assert min_share_of_spread() < 0.97


def test_where_the_map_begins_changes_nothing():
    """The same drive from another start, ten metres off and turned, with a heading in doubt."""
    recording = circle(0, n_frames=60, kr=1e-4, kl=1e-4)
    here = dataclasses.replace(tracking_prior(recording, (0.05, 0.05, 0.1)), mean=np.zeros(3))
    begin, R = np.array([3.0, 10.0, 0.7]), np.eye(3)
    R[:2, :2] = [[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]]
    there = dataclasses.replace(here, mean=begin)
    first, second = (follow(FixedLag(**WHEELS, lag_images=5), recording, p) for p in (here, there))
    np.testing.assert_allclose(second.means, se2.compose(begin, first.means), atol=1e-6)
    np.testing.assert_allclose(second.covariances, R @ first.covariances @ R.T, atol=1e-6)


def test_the_revised_path_is_the_smoothers():
    recording = circle(2, n_frames=60, kr=1e-4, kl=1e-4)
    mine, batch = FixedLag(**WHEELS, lag_images=5), Smoother(**WHEELS)
    follow(mine, recording)
    follow(batch, recording)
    revised, other = mine.finish(), batch.finish()
    assert (revised.kind, revised.status) == ("revised", "ok")
    assert off(revised.means, other.means, other.covariances) < 1e-3
    np.testing.assert_array_equal(revised.map["ids"], other.map["ids"])
    np.testing.assert_allclose(revised.map["landmarks"], other.map["landmarks"], atol=1e-4)


@pytest.mark.parametrize("correlated", [True, False])
def test_derivatives_of_the_observations(correlated):
    recording = circle(0, n_frames=2)
    prior = tracking_prior(recording)
    camera = dataclasses.replace(recording.sensors["stereo"], correlated=correlated)
    prior = dataclasses.replace(prior, sensors={**recording.sensors, "stereo": camera})
    estimator = FixedLag()
    estimator.reset(prior, np.random.default_rng(0))
    points = np.array([[0.3, -0.2, 2.0], [-0.5, 0.1, 3.5]])
    poses = np.tile([0.4, -0.3, 0.7], (2, 1))
    estimator._landmarks = estimator._camera.place(poses, points) + 0.01
    rows, step = np.arange(2), 1e-6
    _, by_pose, by_landmark = estimator._whitened(poses, rows, points)
    tolerance = 1e-5 if correlated else 0.1  # the whitening is held, but depends on the prediction
    for i in range(3):
        d = step * np.eye(3)[i]
        by = [estimator._whitened(poses + s * d, rows, points)[0] for s in (1, -1)]
        scale = np.abs(by_pose).max()
        np.testing.assert_allclose(
            (by[0] - by[1]) / (2 * step) / scale, by_pose[:, :, i] / scale, atol=tolerance
        )
        at, by = estimator._landmarks, []
        for s in (1, -1):
            estimator._landmarks = at + s * d
            by.append(estimator._whitened(poses, rows, points)[0])
        estimator._landmarks = at
        np.testing.assert_allclose(
            (by[0] - by[1]) / (2 * step) / scale, by_landmark[:, :, i] / scale, atol=tolerance
        )


def test_normal_equations_are_those_of_the_dense_jacobian():
    rng = np.random.default_rng(0)
    first, second = np.array([0, 0, 2, 1]), np.array([3, 4, 3, 4])
    A, B, e = rng.normal(size=(4, 3, 3)), rng.normal(size=(4, 3, 3)), rng.normal(size=(4, 3))
    H, g, J = np.zeros((5, 3, 5, 3)), np.zeros((5, 3)), np.zeros((4, 3, 5, 3))
    _add(H, g, first, second, A, B, e)
    J[np.arange(4), :, first], J[np.arange(4), :, second] = A, B
    J = J.reshape(12, 15)
    np.testing.assert_allclose(H.reshape(15, 15), J.T @ J, atol=1e-12)
    np.testing.assert_allclose(g.ravel(), J.T @ e.ravel(), atol=1e-12)


def test_without_landmarks_it_is_dead_reckoning():
    recording = circle(3, n_frames=40)
    log = recording.log("stereo")
    nothing = {name: values[:0] for name, values in log.values.items()}
    blind = with_field(recording, "stereo", np.zeros_like(log.splits), **nothing)
    mine = FixedLag(**WHEELS)
    online, alone = follow(mine, blind), follow(Smoother(**WHEELS), blind)
    np.testing.assert_allclose(online.means, alone.means, atol=1e-12)
    np.testing.assert_allclose(online.covariances, alone.covariances, atol=1e-12)
    assert mine.finish().status == "no_landmarks"


def test_wild_observations_count_for_next_to_nothing():
    """One point in twenty lies anywhere before the camera; online, and in the revised path."""
    recording, rng = circle(3, n_frames=200, kr=1e-4, kl=1e-4), np.random.default_rng(0)
    points = recording.log("stereo")["points_in_camera"].copy()
    wild = rng.random(len(points)) < 0.05
    points[wild] = rng.uniform([0.5, -2.0, -0.5], [8.0, 2.0, 0.5], (wild.sum(), 3))
    odd, truth = with_field(recording, "stereo", points_in_camera=points), recording.truth.poses

    def errors_m(log, **options):
        estimator = FixedLag(**WHEELS, **options)
        paths = follow(estimator, log).means, estimator.finish().means
        return np.array([np.sqrt(np.mean(np.sum((p - truth)[:, :2] ** 2, axis=1))) for p in paths])

    clean = errors_m(recording)
    np.testing.assert_allclose(errors_m(recording, robust="none"), clean, rtol=0.05)
    assert (errors_m(odd) < 2.0 * clean).all()
    assert (errors_m(odd, robust="none") > 10.0 * clean).all()


def test_odd_observations_are_survived():
    """A start known exactly, duplicates, points that no camera can see, a broken prior."""
    recording = circle(2, n_frames=60)
    log = recording.log("stereo")
    points, ids = log["points_in_camera"].copy(), log["ids"].copy()
    points[3], points[4], points[5] = np.nan, [0.1, 0.0, 0.0], [0.1, 0.0, -2.0]
    ids[7] = ids[6]
    odd = with_field(recording, "stereo", points_in_camera=points, ids=ids)
    prior = dataclasses.replace(tracking_prior(recording), covariance=np.zeros((3, 3)))
    online = follow(FixedLag(lag_images=4), odd, prior)
    assert "rejected" in online.status
    assert np.abs(online.means - recording.truth.poses)[:, :2].max() < 0.15
    broken = FixedLag(lag_images=2)
    broken.reset(prior, np.random.default_rng(0))
    frames = list(recording.frames())
    for frame in frames[:10]:
        assert "status" not in broken.step(frame).extras
    covariance = broken._prior.covariance
    covariance -= 10.0 * np.eye(len(covariance))
    belief = broken.step(frames[10])
    assert "not positive definite" in belief.extras["status"]
    assert np.isfinite(belief.mean).all()
    assert len(broken._images) == 1


@pytest.mark.slow
def test_a_laser_adds_what_its_registrations_are_worth():
    """Fused as in full least squares, consistent, and with smaller errors than without."""
    squares, with_laser, without = [], [], []
    for seed in range(8):
        recording = circle(seed, n_frames=60, kr=1e-4, kl=1e-4)
        prior = tracking_prior(recording)
        start = np.random.default_rng([seed, 1]).multivariate_normal(prior.mean, prior.covariance)
        prior = dataclasses.replace(prior, mean=start)
        seeing = FixedLag(**WHEELS, lag_images=1000, iterations=3, laser="laser")
        online = follow(seeing, recording, prior)
        revised = seeing.finish()
        last = slice(58, 59)  # a Frame with an image
        assert off(online.means[last], revised.means[last], revised.covariances[last]) < 0.02
        truth = recording.truth.poses
        squares.append(nees(truth, revised.means, revised.covariances)[[20, 40, 58]])
        blind = follow(FixedLag(**WHEELS), recording, prior)
        moved = se2.between(truth[0], truth)
        for found, errors in ((revised, with_laser), (blind, without)):
            off_start = se2.between(moved, se2.between(found.means[0], found.means))
            errors.append(off_start[2::2, 2])  # at the images
    assert 0.5 < np.mean(squares) / 3.0 < 1.7
    assert np.std(with_laser) < 0.8 * np.std(without)


def test_a_laser_that_is_not_there_is_refused():
    recording = circle(0, n_frames=3)
    with pytest.raises(InputError, match="other"):
        follow(FixedLag(**WHEELS, laser="other"), recording)
