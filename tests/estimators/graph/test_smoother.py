"""Batch least squares against dense solvers, its covariances against errors, and its edges."""

import dataclasses
import functools
import itertools

import numpy as np
import pytest
from scipy.optimize import least_squares

from estimators.base import run
from estimators.gaussian import Gaussian
from estimators.graph.fixed_lag import FixedLag
from estimators.graph.landmark_drive import _between
from estimators.graph.least_squares import LeastSquaresOptions, Problem, solve
from estimators.graph.smoother import Smoother
from estimators.landmarks.stereo import MIN_DEPTH_M, StereoModel
from experiments.evaluation.metrics import nees
from experiments.gate.conform import check_estimator
from sim import se2
from sim.errors import InputError
from sim.sensors import Mount, StereoCamera
from sim.sensors.stereo import points_in_camera
from tests.fixtures.fakes import circle, tracking_prior, with_field

CAMERA = StereoCamera(mount=Mount(x_m=0.2, y_m=-0.1, z_m=0.5, yaw_rad=0.3))
PIXELS = np.array([CAMERA.sigma_column_px, CAMERA.sigma_row_px, CAMERA.sigma_disparity_px])
P0 = np.diag([1e-3, 2e-3, 1e-3])
Q = np.array([[2e-4, 1e-5, 2e-5], [1e-5, 1e-4, 3e-5], [2e-5, 3e-5, 3e-4]])


def small_problem(seed, camera=CAMERA, n_poses=8, n_landmarks=12):
    """A half circle past landmarks: the problem, a guess of the poses, the truth."""
    rng = np.random.default_rng(seed)
    step = np.array([0.3, 0.02, 0.15])
    poses = np.array([[0.0, 0.0, 0.1]])
    for _ in range(n_poses - 1):
        poses = np.vstack([poses, se2.compose(poses[-1], step)])
    landmarks = rng.uniform([1.5, -1.0, 0.0], [5.0, 4.0, 1.2], (n_landmarks, 3))
    first, second = np.arange(n_poses - 1), np.arange(1, n_poses)
    first, second = np.append(first, 0), np.append(second, n_poses - 1)  # and one loop closed
    motions = se2.between(poses[first], poses[second])
    motions = motions + rng.multivariate_normal(np.zeros(3), Q, len(motions))
    rows, seen, points = [], [], []
    for i, pose in enumerate(poses):
        inside = points_in_camera(camera, pose, landmarks)
        visible = np.flatnonzero(inside[:, 2] > 0.5)
        rows += [i] * len(visible)
        seen += visible.tolist()
        points.append(camera.measure(inside[visible], rng))
    _, names = np.unique(seen, return_inverse=True)
    problem = Problem(
        prior_mean=poses[0] + rng.multivariate_normal(np.zeros(3), P0),
        prior_covariance=P0,
        first=first,
        second=second,
        motions=motions,
        motion_covariances=np.tile(Q, (len(motions), 1, 1)),
        camera=StereoModel.of(camera),
        pose_rows=np.array(rows),
        landmark_rows=names,
        points_in_camera=np.concatenate(points),
    )
    guess = poses + 0.1 * rng.standard_normal(poses.shape)
    return problem, guess, poses, landmarks[np.unique(seen)]


def image(points):
    x, y, z = points.T
    z = np.maximum(z, MIN_DEPTH_M)  # wrong ids put landmarks anywhere
    return np.stack([x, y, np.full_like(x, CAMERA.baseline_m)], 1) * CAMERA.focal_px / z[:, None]


def whitened(problem, poses, landmarks, camera=CAMERA, R=None):
    """Residuals worked out apart from the solver: prior, motions, observations (K, 3)."""

    def white(covariance, off):
        return np.linalg.solve(np.linalg.cholesky(covariance), off)

    def wrapped(off):
        return np.append(off[:2], np.arctan2(np.sin(off[2]), np.cos(off[2])))

    out = [white(problem.prior_covariance, wrapped(poses[0] - problem.prior_mean))]
    for a, b, z, C in zip(
        problem.first, problem.second, problem.motions, problem.motion_covariances, strict=True
    ):
        out.append(white(C, wrapped(se2.between(poses[a], poses[b]) - z)))
    seen = []
    for k, (i, n) in enumerate(zip(problem.pose_rows, problem.landmark_rows, strict=True)):
        predicted = points_in_camera(camera, poses[i], landmarks[n][None])
        measured = problem.points_in_camera[k][None]
        if R is None:
            seen.append((image(predicted) - image(measured))[0] / PIXELS)
        else:
            seen.append(white(R[k], (predicted - measured)[0]))
    return np.concatenate(out), np.array(seen)


def dense(problem, poses, landmarks, R=None):
    """SciPy's least squares from here, with derivatives by differences."""
    n = poses.size

    def residuals(x):
        apart = whitened(problem, x[:n].reshape(-1, 3), x[n:].reshape(-1, 3), R=R)
        return np.concatenate([apart[0], apart[1].ravel()])

    start = np.concatenate([poses.ravel(), landmarks.ravel()])
    found = least_squares(residuals, start, method="lm", xtol=1e-12, ftol=1e-12, gtol=1e-12)
    return found, np.linalg.inv(found.jac.T @ found.jac)


@pytest.mark.parametrize("seed", [0, 1])
def test_agrees_with_a_dense_solver(seed):
    problem, guess, poses, landmarks = small_problem(seed)
    mine = solve(problem, guess)
    assert mine.converged
    theirs, covariance = dense(problem, poses, landmarks)
    n = poses.size
    assert mine.cost == pytest.approx(2.0 * theirs.cost, rel=1e-9)
    sigma = np.sqrt(np.diag(covariance))
    off = np.concatenate([mine.poses.ravel(), mine.landmarks.ravel()]) - theirs.x
    assert np.abs(off / sigma).max() < 1e-3
    np.testing.assert_allclose(
        mine.covariance / np.outer(sigma[:n], sigma[:n]),
        covariance[:n, :n] / np.outer(sigma[:n], sigma[:n]),
        atol=1e-4,
    )
    for i, block in enumerate(mine.landmark_covariances):
        rows = slice(n + 3 * i, n + 3 * i + 3)
        np.testing.assert_allclose(block, covariance[rows, rows], rtol=1e-3, atol=1e-7)


def test_diagonal_noise_is_weighed_at_the_solution():
    """With R held at what the solution predicts, a dense solver has nothing to improve."""
    camera = dataclasses.replace(CAMERA, correlated=False)
    problem, guess, _, _ = small_problem(2, camera)
    mine = solve(problem, guess)
    predicted = [
        points_in_camera(camera, mine.poses[i], mine.landmarks[n][None])[0]
        for i, n in zip(problem.pose_rows, problem.landmark_rows, strict=True)
    ]
    theirs, covariance = dense(problem, mine.poses, mine.landmarks, camera.covariance(predicted))
    off = np.concatenate([mine.poses.ravel(), mine.landmarks.ravel()]) - theirs.x
    assert np.abs(off / np.sqrt(np.diag(covariance))).max() < 1e-2


@pytest.mark.parametrize("robust", ["huber", "cauchy"])
def test_robust_losses(robust):
    """A wrong id in 25: squares are led astray, robust losses are not, and sit at a minimum."""
    problem, guess, poses, landmarks = small_problem(3, n_landmarks=40)
    rows = problem.landmark_rows.copy()
    rows[::25] = (rows[::25] + 5) % (rows.max() + 1)
    problem = dataclasses.replace(problem, landmark_rows=rows)
    robustly, squarely = (
        solve(problem, guess, LeastSquaresOptions(robust=r)) for r in (robust, "none")
    )
    error, plain = (np.hypot(*(s.poses - poses)[:, :2].T).max() for s in (robustly, squarely))
    assert error < 0.1 < plain
    assert np.median(np.abs(robustly.landmarks - landmarks)) < 0.1

    def cost(poses, landmarks):
        rest, seen = whitened(problem, poses, landmarks)
        squares = np.sum(seen**2, axis=1)
        huber = np.where(squares > 9.0, 6.0 * np.sqrt(squares) - 9.0, squares)
        loss = huber if robust == "huber" else 9.0 * np.log1p(squares / 9.0)
        return np.sum(rest**2) + np.sum(loss)

    at_minimum = cost(robustly.poses, robustly.landmarks)
    assert robustly.cost == pytest.approx(at_minimum, rel=1e-9)
    rng = np.random.default_rng(0)
    sigma = np.sqrt(np.diag(robustly.covariance)).reshape(-1, 3)
    for _ in range(20):
        poses = robustly.poses + 0.03 * sigma * rng.standard_normal(sigma.shape)
        landmarks = robustly.landmarks + 1e-3 * rng.standard_normal(robustly.landmarks.shape)
        assert cost(poses, landmarks) > at_minimum


def test_agrees_with_gtsam():
    gtsam = pytest.importorskip("gtsam")
    problem, guess, _, _ = small_problem(4)
    mine = solve(problem, guess)
    noise = gtsam.noiseModel
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    turn = _turn(problem.prior_mean[2])
    graph.add(
        gtsam.PriorFactorPose2(
            0,
            gtsam.Pose2(*problem.prior_mean),
            noise.Gaussian.Covariance(turn.T @ problem.prior_covariance @ turn),
        )
    )
    for a, b, z in zip(problem.first, problem.second, problem.motions, strict=True):
        turn = _turn(z[2])  # its errors are in the axes of the second pose
        model = noise.Gaussian.Covariance(turn.T @ Q @ turn)
        graph.add(gtsam.BetweenFactorPose2(int(a), int(b), gtsam.Pose2(*z), model))

    def factor(k):
        keys = [int(problem.pose_rows[k]), 1000 + int(problem.landmark_rows[k])]
        measured = image(problem.points_in_camera[k][None])[0]

        def error(this, values, jacobians):
            pose, landmark = values.atPose2(keys[0]), values.atPoint3(keys[1])

            def seen(pose, landmark):
                at = np.array([pose.x(), pose.y(), pose.theta()])
                return image(points_in_camera(CAMERA, at, landmark[None]))[0]

            if jacobians is not None:
                for i, moved in (
                    (0, lambda d: seen(pose.retract(d), landmark)),
                    (1, lambda d: seen(pose, landmark + d)),
                ):
                    steps = 1e-6 * np.eye(3)
                    jacobians[i] = np.array([moved(d) - moved(-d) for d in steps]).T / 2e-6
            return seen(pose, landmark) - measured

        return gtsam.CustomFactor(noise.Diagonal.Sigmas(PIXELS), keys, error)

    for k in range(len(problem.pose_rows)):
        graph.add(factor(k))
    for i, pose in enumerate(mine.poses + 0.02):
        values.insert(i, gtsam.Pose2(*pose))
    for n, landmark in enumerate(mine.landmarks + 0.05):
        values.insert(1000 + n, landmark)
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    marginals = gtsam.Marginals(graph, found)
    for i, pose in enumerate(mine.poses):
        theirs = found.atPose2(i)
        block = mine.covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3]
        off = np.array([theirs.x(), theirs.y(), theirs.theta()]) - pose
        assert np.abs(off / np.sqrt(np.diag(block))).max() < 0.05  # its motions err on a tangent
        turn = _turn(theirs.theta())
        P = turn @ marginals.marginalCovariance(i) @ turn.T
        np.testing.assert_allclose(P, block, rtol=0.05, atol=0.03 * np.abs(block).max())


def _turn(angle):
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def test_poses_filled_in_are_those_of_the_whole_problem():
    """Solving the ends with merged motions, then filling in, equals solving every pose."""
    rng = np.random.default_rng(5)
    motions = [
        Gaussian(np.array([0.1, 0.01, 0.1]), 0.01 * Q * rng.uniform(0.5, 2)) for _ in "12345"
    ]
    problem, _, _, _ = small_problem(5)
    none = dict.fromkeys(("pose_rows", "landmark_rows"), np.zeros(0, np.int64))

    def of(steps, closing):
        n = len(steps)
        pull = np.array([0.01, -0.01, 0.005])
        return dataclasses.replace(
            problem,
            first=np.append(np.arange(n), 0),
            second=np.append(np.arange(1, n + 1), n),
            motions=np.array([*(s.mean for s in steps), closing.mean + pull]),
            motion_covariances=np.array([*(s.covariance for s in steps), 0.02 * Q]),
            points_in_camera=np.zeros((0, 3)),
            **none,
        )

    closing = functools.reduce(Gaussian.then, motions)
    start = [problem.prior_mean]
    for motion in motions:
        start.append(se2.compose(start[-1], motion.mean))
    whole = solve(of(motions, closing), np.array(start))
    ends = solve(of([closing], closing), np.array(start)[[0, -1]])
    between = _between(motions, ends.poses, ends.covariance)
    assert len(between) == 4
    for i, pose in enumerate(between, start=1):
        block = whole.covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3]
        sigma = np.sqrt(np.diag(block))
        assert np.abs((pose.mean - whole.poses[i]) / sigma).max() < 0.01
        scale = np.outer(sigma, sigma)
        np.testing.assert_allclose(pose.covariance / scale, block / scale, atol=0.01)


def test_errors_are_within_their_covariances():
    """Over many recordings, at their middle and end, and of the landmarks."""
    squares, of_landmarks, ratios = [], [], []
    for seed in range(20):
        recording = circle(seed, n_frames=50, kr=1e-4, kl=1e-4)
        rng = np.random.default_rng([seed, 1])
        prior = tracking_prior(recording)
        start = rng.multivariate_normal(prior.mean, prior.covariance)
        smoother = Smoother(kr=1e-4, kl=1e-4)
        online = run(smoother, recording, dataclasses.replace(prior, mean=start), rng)
        revised = smoother.finish()
        assert (revised.kind, revised.status) == ("revised", "ok")
        truth = recording.truth.poses
        squares.append(nees(truth, revised.means, revised.covariances)[[7, 30, 49]])
        off = revised.map["landmarks"] - recording.truth.world.landmarks[revised.map["ids"]]
        P = revised.map["landmark_covariances"]
        of_landmarks.append(
            np.mean([e @ np.linalg.solve(C, e) for e, C in zip(off, P, strict=True)])
        )
        ratios.append(np.linalg.norm((revised.means - truth)[30:, :2]))
        ratios[-1] /= np.linalg.norm((online.means - truth)[30:, :2])
    assert 0.7 < np.mean(squares) / 3.0 < 1.4  # 20 runs: sigma 0.18 if all were one
    assert 0.7 < np.mean(of_landmarks) / 3.0 < 1.35
    assert np.median(ratios) < 0.8


def test_online_is_dead_reckoning_and_finish_can_be_asked_at_any_time():
    recording = circle(1, n_frames=40)
    blind = recording.without("stereo")
    prior = tracking_prior(recording)
    seeing, other = Smoother(), Smoother()
    rng = np.random.default_rng(0)
    first, second = run(seeing, recording, prior, rng), run(other, blind, prior, rng)
    np.testing.assert_array_equal(first.means, second.means)
    revised = other.finish()
    assert revised.status == "no_landmarks"
    np.testing.assert_allclose(revised.means, second.means, atol=1e-6)
    np.testing.assert_allclose(revised.covariances, second.covariances, rtol=0.02, atol=1e-7)
    half = Smoother()
    half.reset(prior, rng)
    for frame in itertools.islice(recording.frames(), 20):
        half.step(frame)
    early = half.finish()
    assert len(early.stamps) == 20
    for frame in itertools.islice(recording.frames(), 20, None):
        half.step(frame)
    np.testing.assert_array_equal(half.finish().means, seeing.finish().means)
    assert np.trace(early.covariances[10]) >= np.trace(seeing.finish().covariances[10])


def test_odd_observations_are_survived():
    """A start known exactly, one Frame, duplicates, points that no camera can see."""
    recording = circle(2, n_frames=40)
    log = recording.log("stereo")
    points, ids = log["points_in_camera"].copy(), log["ids"].copy()
    points[3], points[4], points[5] = np.nan, [0.1, 0.0, 0.0], [0.1, 0.0, -2.0]
    ids[7] = ids[6]
    odd = with_field(recording, "stereo", points_in_camera=points, ids=ids)
    prior = dataclasses.replace(tracking_prior(recording), covariance=np.zeros((3, 3)))
    smoother = Smoother(robust="cauchy")
    assert "rejected" in run(smoother, odd, prior, np.random.default_rng(0)).status
    revised = smoother.finish()
    assert np.abs(revised.means - recording.truth.poses)[:, :2].max() < 0.1
    assert np.all(np.linalg.eigvalsh(revised.covariances) > 0.0)
    run(smoother, recording.cut(1), prior, np.random.default_rng(0))
    assert smoother.finish().means.shape == (1, 3)


@pytest.mark.parametrize("method", [Smoother, FixedLag])
def test_conforms(method):
    recording = circle(3, n_frames=30)
    for check in check_estimator(method, recording, tracking_prior(recording)):
        assert check.passed, f"{check.name}: {check.message}"


@pytest.mark.parametrize("method", [Smoother, FixedLag])
def test_what_is_missing_is_named(method):
    recording = circle(0, n_frames=10)
    prior, rng = tracking_prior(recording), np.random.default_rng(0)
    with pytest.raises(InputError, match="start pose"):
        method().reset(dataclasses.replace(prior, mean=None), rng)
    with pytest.raises(InputError, match="identifies"):
        run(method(), circle(0, n_frames=10, identifies=False), prior, rng)
    fresh = method()
    fresh.reset(prior, rng)
    with pytest.raises(InputError, match="no Frame"):
        fresh.finish()


@pytest.mark.parametrize(
    ("method", "wrong", "word"),
    [
        (Smoother, {"robust": "tukey"}, "cauchy"),
        (Smoother, {"robust_sigma": 0.0}, "robust_sigma"),
        (Smoother, {"kl": np.nan}, "kl"),
        (Smoother, {"max_iterations": 0}, "max_iterations"),
        (FixedLag, {"lag_images": 0}, "lag_images"),
        (FixedLag, {"iterations": 1.5}, "iterations"),
        (FixedLag, {"kl": np.nan}, "kl"),
    ],
)
def test_wrong_options_are_named(method, wrong, word):
    with pytest.raises(InputError, match=word):
        method(**wrong)
