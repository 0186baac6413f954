"""EKF-SLAM against a plain dense filter, a batch solution, and its own covariances."""

import dataclasses

import numpy as np
import pytest
import scipy.linalg

from estimators.base import run
from estimators.graph.smoother import Smoother
from estimators.landmarks.ekf_slam import EkfSlam
from experiments.evaluation.metrics import nees
from experiments.gate.conform import check_estimator
from sim import se2
from sim.errors import InputError
from sim.robot.arc import TravelWindow, arc_increment
from sim.sensors import Mount
from sim.sensors.stereo import points_in_camera
from tests.fixtures.derivatives import slope
from tests.fixtures.fakes import circle, tracking_prior, true_ids, with_descriptors, with_field

K_M = 1e-4  # kr and kl
WHEELS = {"kr": K_M, "kl": K_M}


def follow(estimator, recording, prior=None, seed=0, keep=("associations", "status")):
    prior = prior or tracking_prior(recording)
    return run(estimator, recording, prior, np.random.default_rng(seed), keep)


def joined(estimate):
    images = [a for a in estimate.extras["associations"] if a is not None]
    return np.concatenate(images)


def of_the_map(mean):
    """T (n, n) of errors of coordinates = T errors of the map, as Barrau and Bonnabel have them."""
    T = np.eye(len(mean))
    for row in (0, *range(3, len(mean), 3)):
        T[row : row + 2, 2] = -mean[row + 1], mean[row]
    return T


def moved_as_a_map(mean, error):
    """Every position x is R(e_turn) x + e_x, with the exponential of SE(2) as SciPy has it."""
    after = mean + error
    for row in (0, *range(3, len(mean), 3)):
        twist = np.zeros((3, 3))
        twist[:2] = [[0.0, -error[2], error[row]], [error[2], 0.0, error[row + 1]]]
        after[row : row + 2] = (scipy.linalg.expm(twist) @ [*mean[row : row + 2], 1.0])[:2]
    return after


def plain(recording, prior, camera, errors):
    """The same filter in the plainest form: dense, derivatives by differences, Joseph updates."""
    mean, P = prior.mean.copy(), prior.covariance.copy()
    row_of, window, beliefs = {}, TravelWindow(0.05), []
    turned = camera.mount.yaw_rad
    for frame in recording.frames():
        n, travel = len(mean), frame.wheel_increments_m
        variances = K_M * window.push(frame.duration_s, travel)

        def moved(x, travel):
            return np.append(
                se2.compose(x[:3], arc_increment(travel, recording.robot.track_m)), x[3:]
            )

        F = slope(lambda x: moved(x, travel), mean)  # noqa: B023
        G = slope(lambda t: moved(mean, t), travel)  # noqa: B023
        mean, P = moved(mean, travel), F @ P @ F.T + G @ np.diag(variances) @ G.T
        if "stereo" in frame.readings:
            image = frame.readings["stereo"]
            seen = list(zip(image["ids"], image["points_in_camera"], strict=True))
            known = [(row_of[i], z) for i, z in seen if i in row_of]

            def predicted(x):
                return np.concatenate(
                    [points_in_camera(camera, x[:3], x[r : r + 3][None])[0] for r, _ in known]  # noqa: B023
                )

            if known:
                h, H = predicted(mean), slope(predicted, mean)
                R, v = np.zeros((len(h), len(h))), []
                for k, (_, z) in enumerate(known):
                    at = h[3 * k : 3 * k + 3]
                    R[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = camera.covariance(at)
                    v.append((z - at) * at[2] / z[2])  # of the image
                K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
                keep = np.eye(n) - K @ H
                by, P = K @ np.concatenate(v), keep @ P @ keep.T + K @ R @ K.T
                if errors == "invariant":
                    before = np.linalg.inv(of_the_map(mean))
                    mean = moved_as_a_map(mean, before @ by)
                    P = of_the_map(mean) @ before @ P @ before.T @ of_the_map(mean).T
                else:
                    mean = mean + by
            for i, z in seen:
                if i in row_of:
                    continue

                def placed(x, z):
                    heading = x[2] + turned
                    eye = se2.compose(x[:3], camera.mount.pose)[:2]
                    ahead = np.array([np.cos(heading), np.sin(heading)])
                    right = np.array([np.sin(heading), -np.cos(heading)])
                    return np.append(eye + z[2] * ahead + z[0] * right, camera.mount.z_m - z[1])

                J = slope(lambda x: placed(x, z), mean)  # noqa: B023
                C = slope(lambda z: placed(mean, z), z)  # noqa: B023
                row_of[i] = len(mean)
                own = J @ P @ J.T + C @ camera.covariance(z) @ C.T
                P = np.block([[P, P @ J.T], [J @ P, own]])
                mean = np.append(mean, placed(mean, z))
        beliefs.append((mean[:3].copy(), P[:3, :3].copy()))
    return beliefs, mean, P


@pytest.mark.parametrize("errors", ["coordinates", "invariant"])
def test_is_the_filter_written_plainly(errors):
    recording = circle(0, n_frames=24, kr=K_M, kl=K_M)
    mount = Mount(x_m=0.15, y_m=-0.05, z_m=0.4, yaw_rad=0.2)
    camera = dataclasses.replace(recording.sensors["stereo"], mount=mount)
    sensors = {**recording.sensors, "stereo": camera}
    prior = dataclasses.replace(tracking_prior(recording), sensors=sensors)
    filtered = EkfSlam(**WHEELS, errors=errors)
    online = follow(filtered, recording, prior)
    beliefs, mean, P = plain(recording, prior, camera, errors)
    for i, (at, covariance) in enumerate(beliefs):
        np.testing.assert_allclose(online.means[i], at, atol=1e-6)
        np.testing.assert_allclose(online.covariances[i], covariance, rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(filtered.map["landmarks"].ravel(), mean[3:], atol=1e-6)
    for n, block in enumerate(filtered.map["landmark_covariances"]):
        rows = slice(3 + 3 * n, 6 + 3 * n)
        np.testing.assert_allclose(block, P[rows, rows], rtol=1e-4, atol=1e-8)


def test_ends_where_batch_least_squares_does():
    """With little noise the filter is linear, and its last belief is the optimum's."""
    recording = circle(4, n_frames=60, kr=1e-6, kl=1e-6)
    prior = tracking_prior(recording, sigma=(0.01, 0.01, 0.002))
    batch, filtered = Smoother(kr=1e-6, kl=1e-6), EkfSlam(kr=1e-6, kl=1e-6)
    follow(batch, recording, prior)
    online, revised = follow(filtered, recording, prior), batch.finish()
    sigma = np.sqrt(np.diag(revised.covariances[-1]))
    assert np.abs((online.means[-1] - revised.means[-1]) / sigma).max() < 0.5
    np.testing.assert_allclose(np.sqrt(np.diag(online.covariances[-1])), sigma, rtol=0.1)


def test_errors_are_within_their_covariances():
    """With known ids, in the middle and at the end of many recordings; and of the landmarks."""
    squares, of_landmarks = [], []
    for seed in range(25):
        recording = circle(seed, n_frames=60, kr=K_M, kl=K_M)
        prior = tracking_prior(recording)
        start = np.random.default_rng([seed, 1]).multivariate_normal(prior.mean, prior.covariance)
        filtered = EkfSlam(**WHEELS)
        online = follow(filtered, recording, dataclasses.replace(prior, mean=start))
        truth = recording.truth.poses
        squares.append(nees(truth, online.means, online.covariances)[[10, 31, 59]])
        off = filtered.map["landmarks"] - recording.truth.world.landmarks[filtered.map["ids"]]
        P = filtered.map["landmark_covariances"]
        of_landmarks.append(np.mean(np.sum(off * np.linalg.solve(P, off[..., None])[..., 0], 1)))
        ids = true_ids(recording)
        assert np.array_equal(ids[joined(online)], ids)
    assert 0.7 < np.mean(squares) / 3.0 < 1.35
    # Depth by disparity is skew: a few runs have their landmarks far off, the median has not
    assert 0.6 < np.median(of_landmarks) / 3.0 < 1.5


def test_little_noise_makes_both_errors_alike():
    """With a known heading both forms of the error are the same filter to first order."""
    recording = circle(4, n_frames=60, kr=1e-6, kl=1e-6)
    prior = tracking_prior(recording, sigma=(0.01, 0.01, 0.002))
    plain_one = EkfSlam(kr=1e-6, kl=1e-6, errors="coordinates")
    other = EkfSlam(kr=1e-6, kl=1e-6)
    first, second = follow(plain_one, recording, prior), follow(other, recording, prior)
    np.testing.assert_allclose(second.means, first.means, atol=3e-3)
    sigma = [np.sqrt(np.diagonal(e.covariances, axis1=1, axis2=2)) for e in (first, second)]
    np.testing.assert_allclose(sigma[1], sigma[0], rtol=0.1)
    np.testing.assert_allclose(
        other.map["landmark_covariances"],
        plain_one.map["landmark_covariances"],
        rtol=0.2,
        atol=3e-5,
    )


@pytest.mark.parametrize("errors", ["coordinates", "invariant"])
def test_where_the_map_begins_changes_nothing(errors):
    """The same drive from another start, ten metres off and turned, with a heading in doubt."""
    recording = circle(0, n_frames=60, kr=K_M, kl=K_M)
    here = dataclasses.replace(tracking_prior(recording, (0.05, 0.05, 0.1)), mean=np.zeros(3))
    begin = np.array([3.0, 10.0, 0.7])
    R = np.eye(3)
    R[:2, :2] = [[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]]
    there = dataclasses.replace(here, mean=begin)
    first, second = (follow(EkfSlam(**WHEELS, errors=errors), recording, p) for p in (here, there))
    np.testing.assert_allclose(second.means, se2.compose(begin, first.means), atol=1e-7)
    np.testing.assert_allclose(second.covariances, R @ first.covariances @ R.T, atol=1e-7)


def test_seeing_landmarks_again_does_not_tell_where_north_is():
    """No update may lower the uncertainty of the whole map's heading, given at the start."""
    spread = 0.3
    least = {}
    for errors in ("coordinates", "invariant"):
        sigmas = []
        for seed in range(3):
            recording = circle(seed, n_frames=200, kr=1e-3, kl=1e-3)
            prior = tracking_prior(recording, sigma=(0.02, 0.02, spread))
            turned = prior.mean + np.array([0.0, 0.0, spread])
            filtered = EkfSlam(kr=1e-3, kl=1e-3, errors=errors)
            online = follow(filtered, recording, dataclasses.replace(prior, mean=turned))
            sigmas.append(np.sqrt(online.covariances[:, 2, 2].min()))
        least[errors] = min(sigmas)
    assert least["invariant"] > 0.999 * spread
    assert least["coordinates"] < 0.9 * spread


def misread(recording, share, seed=0):
    """The recording with this share of its ids replaced by those of any landmark."""
    rng = np.random.default_rng(seed)
    ids = recording.log("stereo")["ids"].copy()
    wrong = rng.random(len(ids)) < share
    ids[wrong] = rng.integers(len(recording.truth.world.landmarks), size=int(wrong.sum()))
    return with_field(recording, "stereo", ids=ids)


def test_the_gate_leaves_misread_ids_out():
    off = {}
    for seed in range(3):
        recording = misread(circle(seed, n_frames=100, kr=K_M, kl=K_M), 0.02, seed)
        for gate in (None, 1e-6):
            filtered = EkfSlam(**WHEELS, gate_probability=gate, errors="coordinates")
            online = follow(filtered, recording)
            off.setdefault(gate, []).append(
                np.hypot(*(online.means - recording.truth.poses)[:, :2].T).max()
            )
    assert max(off[1e-6]) < 0.1
    assert min(off[None]) > 2.0 * max(off[1e-6])


def test_a_misread_id_starts_no_landmark():
    recording = circle(0, n_frames=20)
    log = recording.log("stereo")
    ids = log["ids"].copy()
    ids[0] = 999  # seen once
    filtered = EkfSlam(**WHEELS, gate_probability=1e-6)
    online = follow(filtered, with_field(recording, "stereo", ids=ids))
    assert joined(online)[0] == -1
    assert 999 not in filtered.map["ids"]
    assert len(filtered.map["ids"]) > 5


@pytest.mark.slow
def test_errors_that_last_are_counted_once():
    """An error that stays for half a second is one measurement, not three.

    It shows most in the classical filter, to which repeats also tell headings that nothing shows.
    """
    values = {0.0: [], 0.5: []}
    for seed in range(12):
        recording = circle(seed, n_frames=100, kr=K_M, kl=K_M)
        log, camera = recording.log("stereo"), recording.sensors["stereo"]
        rows = np.repeat(np.arange(len(log.stamps)), np.diff(log.splits))
        poses, landmarks = recording.truth.poses[::2], recording.truth.world.landmarks
        clean = np.array(
            [
                points_in_camera(camera, poses[row], landmarks[None, i])[0]
                for row, i in zip(rows, true_ids(recording), strict=True)
            ]
        )
        noise = np.random.default_rng([seed, 2]).standard_normal((50, len(landmarks), 3))
        lasting = noise[rows // 3, true_ids(recording)] * np.array([0.02, 0.02, 0.05])
        held = with_field(recording, "stereo", points_in_camera=clean + lasting)
        for repeat_s, squares in values.items():
            believed = {"sigma_disparity_px": 0.35, "errors": "coordinates"}
            filtered = EkfSlam(**WHEELS, **believed, repeat_s=repeat_s)
            online = follow(filtered, held)
            squares.append(nees(recording.truth.poses, online.means, online.covariances)[20:])
    assert np.mean(values[0.5]) < 0.7 * np.mean(values[0.0])


def described(recording, seed=0, sigma=0.05):
    """The recording with a descriptor of each observation, unlike each other's."""
    rng = np.random.default_rng(seed)
    of_landmark = rng.standard_normal((len(recording.truth.world.landmarks), 64))
    of_landmark /= np.linalg.norm(of_landmark, axis=1, keepdims=True)
    noise = sigma / 8.0 * rng.standard_normal((len(true_ids(recording)), 64))
    seen = of_landmark[true_ids(recording)] + noise
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    return with_descriptors(recording, seen)


def test_associations():
    """Nearest neighbours err among close landmarks; descriptors settle it."""
    rights = {"mahalanobis": [], "descriptor": []}
    for seed in range(4):
        blind = circle(seed, n_frames=60, kr=1e-3, kl=1e-3, identifies=False)
        recording = described(blind)
        for association, shares in rights.items():
            filtered = EkfSlam(kr=1e-3, kl=1e-3, association=association)
            online = follow(filtered, recording)
            ids, first = true_ids(recording), joined(online)
            assert len(first) == len(ids)
            shares.append(np.mean(ids[first] == ids))
            for rows, image in zip(
                np.split(first, recording.log("stereo").splits[1:-1]),
                np.split(ids, recording.log("stereo").splits[1:-1]),
                strict=True,
            ):
                assert len(np.unique(rows)) == len(image)  # each landmark once an image
    assert min(rights["descriptor"]) > 0.97
    assert min(rights["mahalanobis"]) > 0.6
    assert np.mean(rights["descriptor"]) > np.mean(rights["mahalanobis"])


def test_threshold_decides_what_is_new():
    recording = circle(1, n_frames=30, identifies=False)
    sizes = []
    for d0 in (0.5, 16.27):
        filtered = EkfSlam(**WHEELS, association="mahalanobis", d0=d0)
        follow(filtered, recording)
        sizes.append(len(filtered.map["landmarks"]))
    n_seen = len(np.unique(true_ids(recording)))
    assert sizes[0] > 2 * n_seen  # chi-square with 3 degrees of freedom: 92 % are beyond 0.5
    assert sizes[1] <= n_seen + 1


def test_odd_observations_are_told_and_survived():
    recording = circle(2, n_frames=30)
    log = recording.log("stereo")
    points, ids = log["points_in_camera"].copy(), log["ids"].copy()
    first, second = log.splits[np.flatnonzero(np.diff(log.splits) >= 4)[:2]]
    points[first + 1 : first + 4] = [[np.nan] * 3, [0.1, 0.0, 0.0], [0.1, 0.0, -2.0]]
    ids[second + 1] = ids[second]
    odd = with_field(recording, "stereo", points_in_camera=points, ids=ids)
    prior = dataclasses.replace(tracking_prior(recording), covariance=np.zeros((3, 3)))
    online = follow(EkfSlam(**WHEELS), odd, prior)
    images = [s for s in online.extras["status"] if s is not None]
    assert images == ["observation without depth rejected", "duplicate id rejected"]
    births = joined(online)
    assert births[first] == first
    assert list(births[first + 1 : first + 4]) == [-1, -1, -1]
    assert births[second + 1] == -1
    assert np.abs(online.means - recording.truth.poses)[:, :2].max() < 0.15


def test_a_broken_covariance_is_told():
    recording = circle(0, n_frames=12)
    filtered = EkfSlam(**WHEELS)
    filtered.reset(tracking_prior(recording), np.random.default_rng(0))
    frames = list(recording.frames())
    assert "status" not in filtered.step(frames[0]).extras
    covariance = filtered._state.covariance
    covariance -= 10.0 * np.eye(len(covariance))
    assert "broken" in filtered.step(frames[2]).extras["status"]


def test_without_landmarks_it_is_dead_reckoning():
    recording = circle(3, n_frames=210, n_beams=1)
    log = recording.log("stereo")
    nothing = {name: values[:0] for name, values in log.values.items()}
    blind = with_field(recording, "stereo", np.zeros_like(log.splits), **nothing)
    online, alone = (follow(e(**WHEELS), blind) for e in (EkfSlam, Smoother))
    np.testing.assert_allclose(online.means, alone.means, atol=1e-9)
    np.testing.assert_allclose(online.covariances, alone.covariances, rtol=1e-6, atol=1e-12)
    told = [s for s in online.extras["status"] if s is not None]
    assert told[0] == "no landmark in 100 images"


@pytest.mark.parametrize("association", ["known", "mahalanobis"])
def test_conforms(association):
    recording = circle(3, n_frames=30, identifies=association == "known")
    checks = check_estimator(
        lambda: EkfSlam(association=association), recording, tracking_prior(recording)
    )
    for check in checks:
        assert check.passed, f"{check.name}: {check.message}"


def test_wrong_input_is_named():
    recording = circle(0, n_frames=6, identifies=False)
    prior, rng = tracking_prior(recording), np.random.default_rng(0)
    with pytest.raises(InputError, match="association"):
        EkfSlam().reset(prior, rng)
    with pytest.raises(InputError, match="start pose"):
        EkfSlam().reset(dataclasses.replace(prior, mean=None), rng)
    with pytest.raises(InputError, match="descriptors"):
        follow(EkfSlam(association="descriptor"), recording)
    for options, word in (
        ({"association": "nearest"}, "mahalanobis"),
        ({"d0": 0.0}, "d0"),
        ({"errors": "twists"}, "invariant"),
        ({"gate_probability": 1.0}, "gate_probability"),
        ({"repeat_s": -1.0}, "repeat_s"),
        ({"repeat_s": 0.5, "association": "mahalanobis"}, "repeat_s apply to ids"),
        ({"kr": -1.0}, "kr"),
        ({"sigma_row_px": np.nan}, "sigma_row_px"),
        ({"noise_model": "flat"}, "diagonal"),
        ({"noise_at": "later"}, "noise_at"),
    ):
        with pytest.raises(InputError, match=word):
            EkfSlam(**options)
