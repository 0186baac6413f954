"""The least covariance of a path against Kalman, Rauch-Tung-Striebel, least squares and gtsam."""

import dataclasses
import itertools

import numpy as np
import pytest

from experiments.evaluation.pose_bound import Chain, Sights, bound_dead_reckoning, bound_path
from experiments.evaluation.scan_bound import fisher_information
from experiments.evaluation.sensor_information import (
    WheelNoise,
    laser_information,
    motion_terms,
    stereo_information,
)
from sim import se2
from sim.arrays import Array
from sim.robot.arc import arc_increment, arc_increment_jacobian
from sim.sensors import Laser, StereoCamera
from sim.sensors.base import Mount
from sim.worlds.world import World

CAMERA = StereoCamera(mount=Mount(x_m=0.1, y_m=-0.05, z_m=0.5, yaw_rad=0.2))
WALLS = np.array([[-4.0, -3, 5, -3], [5, -3, 5, 4], [5, 4, -4, 4], [-4, 4, -4, -3], [1, 2, 2, 1]])
ROOM = World("room", WALLS, np.tile([0.0, 2.0], (5, 1)))


def random_chain(rng: np.random.Generator, n: int, *, seen: int = 0, every: int = 1) -> Chain:
    """A linear-Gaussian chain; of `seen` > 0, with two of so many landmarks at `every` pose."""
    F = np.eye(3) + 0.1 * rng.standard_normal((n, 3, 3))
    roots, A = rng.standard_normal((n, 3, 3)), rng.standard_normal((n, 2, 3, 3))
    Q, own = roots @ roots.transpose(0, 2, 1), A.transpose(0, 1, 3, 2) @ A
    if not seen:
        return Chain(np.diag([1.0, 2.0, 0.5]), F, Q, own[:, 0])
    B = rng.standard_normal(A.shape)
    rows = np.repeat(np.arange(n), 2)
    drawn = np.array([rng.choice(seen, 2, replace=False) for _ in range(n)]).ravel()
    order = {int(name): number for number, name in enumerate(dict.fromkeys(drawn.tolist()))}
    numbers = np.array([order[int(name)] for name in drawn])
    cross, of_landmark = A.transpose(0, 1, 3, 2) @ B, B.transpose(0, 1, 3, 2) @ B
    sights = Sights(rows, numbers, cross.reshape(-1, 3, 3), of_landmark.reshape(-1, 3, 3))
    information = own.sum(axis=1)
    if every > 1:
        blind = np.arange(n) % every != 1
        information[blind] = 0.0
        sights = Sights(*(part[~blind[rows]] for part in sights))
        order = dict.fromkeys(sights.landmarks.tolist())
        numbers = np.array([list(order).index(number) for number in sights.landmarks.tolist()])
        sights = sights._replace(landmarks=numbers)
    return Chain(np.diag([1.0, 2.0, 0.5]), F, Q, information, sights)


def joint_covariance(chain: Chain, n: int) -> Array:
    """Covariance (d n + 3 L, ...) of the first n poses and the landmarks seen: plain inversion."""
    sights, d = chain.sights, len(chain.start)
    used = 0 if sights is None else int(np.searchsorted(sights.rows, n))
    n_seen = 1 + int(sights.landmarks[:used].max()) if sights is not None and used else 0
    J = np.zeros((d * n + 3 * n_seen,) * 2)
    J[:d, :d] = np.linalg.inv(chain.start)
    for k in range(n):
        at = slice(d * k, d * k + d)
        J[at, at] += chain.information[k]
        if k:
            both = slice(d * k - d, d * k + d)
            E = np.hstack([-chain.by_before[k], np.eye(d)])
            J[both, both] += E.T @ np.linalg.inv(chain.noise[k]) @ E
    for i in range(used):
        assert sights is not None
        at = slice(d * sights.rows[i], d * sights.rows[i] + d)
        of = slice(d * n + 3 * sights.landmarks[i], d * n + 3 * sights.landmarks[i] + 3)
        J[at, of] += sights.cross[i]
        J[of, at] += sights.cross[i].T
        J[of, of] += sights.own[i]
    return np.asarray(np.linalg.inv(J))


def random_team(rng: np.random.Generator, n: int) -> Chain:
    """A chain of two robots that see the same landmarks and each other."""
    both = [random_chain(rng, n, seen=4) for _ in range(2)]
    blocks = np.zeros((2, n, 6, 6))
    sights = list[Sights]()
    for number, own in enumerate(both):
        at = slice(3 * number, 3 * number + 3)
        blocks[:, :, at, at] = own.by_before, own.noise
        assert own.sights is not None
        cross = np.zeros((len(own.sights.rows), 6, 3))
        cross[:, at] = own.sights.cross
        sights.append(own.sights._replace(cross=cross))
    H = rng.standard_normal((n, 2, 6))  # of each sighting, by both poses
    parts = [np.concatenate(each) for each in zip(*sights, strict=True)]
    order = np.argsort(parts[0], kind="stable")
    seen = Sights(*(part[order] for part in parts))
    renamed = list(dict.fromkeys(seen.landmarks.tolist()))
    numbers = np.array([renamed.index(number) for number in seen.landmarks.tolist()])
    information = H.transpose(0, 2, 1) @ H
    for row, cross, landmark in zip(seen.rows, seen.cross, seen.own, strict=True):
        information[row] += cross @ np.linalg.inv(landmark) @ cross.T
    return Chain(np.eye(6), *blocks, information, seen._replace(landmarks=numbers))


def test_landmarks_that_are_seen_late_tell_nothing_before() -> None:
    chain = random_team(np.random.default_rng(4), 80)
    assert chain.sights is not None
    late = chain.sights.rows >= 40
    first = list(dict.fromkeys(chain.sights.landmarks[late].tolist()))
    numbers = np.array([first.index(number) for number in chain.sights.landmarks[late].tolist()])
    sights = Sights(*(part[late] for part in chain.sights))._replace(landmarks=numbers)
    online = bound_path(chain._replace(sights=sights)).online
    wanted = bound_path(chain._replace(sights=None)).online
    np.testing.assert_allclose(online[:40], wanted[:40], rtol=1e-9)


@pytest.mark.parametrize(("seen", "every"), [(0, 1), (4, 1), (4, 3), (-1, 1)])
def test_bound_is_the_inverse_of_the_joint_information(seen: int, every: int) -> None:
    rng = np.random.default_rng(3)
    chain = random_team(rng, 30) if seen < 0 else random_chain(rng, 30, seen=seen, every=every)
    bound, d = bound_path(chain), len(chain.start)
    for n in (1, 2, 17, 30):
        last = slice(d * n - d, d * n)
        wanted = joint_covariance(chain, n)[last, last]
        np.testing.assert_allclose(bound.online[n - 1], wanted, rtol=1e-9, atol=1e-11)
    whole = joint_covariance(chain, 30)[: 30 * d, : 30 * d].reshape(30, d, 30, d)
    np.testing.assert_allclose(bound.revised, whole[range(30), :, range(30)], rtol=1e-9, atol=1e-11)


def test_bound_is_that_of_kalman_and_of_rauch_tung_striebel() -> None:
    rng = np.random.default_rng(5)
    n, H, R = 25, rng.standard_normal((2, 3)), np.diag([0.3, 0.7])
    F, Q = np.eye(3) + 0.1 * rng.standard_normal((n, 3, 3)), np.diag([0.1, 0.2, 0.05])
    chain = Chain(
        np.eye(3), F, np.tile(Q, (n, 1, 1)), np.tile(H.T @ np.linalg.inv(R) @ H, (n, 1, 1))
    )
    P, filtered, before = np.eye(3), [], []
    for k in range(n):
        P = F[k] @ P @ F[k].T + Q if k else P
        before.append(P)
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        P = (np.eye(3) - K @ H) @ P
        filtered.append(P)
    smoothed = [filtered[-1]]
    for k in range(n - 2, -1, -1):
        C = filtered[k] @ F[k + 1].T @ np.linalg.inv(before[k + 1])
        smoothed.insert(0, filtered[k] + C @ (smoothed[0] - before[k + 1]) @ C.T)
    bound = bound_path(chain)
    np.testing.assert_allclose(bound.online, filtered, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(bound.revised, smoothed, rtol=1e-9, atol=1e-12)


def test_known_start_and_robot_at_rest() -> None:
    """Neither has a finite information."""
    chain = random_chain(np.random.default_rng(1), 12, seen=3)
    noise = chain.noise.copy()
    noise[4:7] = 0.0
    exact = chain._replace(start=np.zeros((3, 3)), noise=noise)
    nearly = chain._replace(start=1e-9 * np.eye(3), noise=noise + 1e-9 * np.eye(3))
    for given, wanted in zip(bound_path(exact), bound_path(nearly), strict=True):
        np.testing.assert_allclose(given, wanted, atol=1e-6)


def test_long_path_is_bounded_from_below(monkeypatch: pytest.MonkeyPatch) -> None:
    chain = random_chain(np.random.default_rng(8), 60, seen=4)
    monkeypatch.setattr("experiments.evaluation.pose_bound._GROUPS", 60)
    exact = bound_path(chain)
    monkeypatch.setattr("experiments.evaluation.pose_bound._GROUPS", 7)
    fewer = bound_path(chain)
    assert np.linalg.eigvalsh(exact.online - fewer.online).min() > -1e-12
    np.testing.assert_allclose(fewer.revised, exact.revised)


def test_motion_against_samples() -> None:
    wheels = WheelNoise(np.array([1e-4, 3e-4]), 2e-4, 0.3)
    start, travel_m = np.array([1.0, 2.0, 0.7]), np.array([0.5, 0.3])
    end = se2.compose(start, arc_increment(travel_m, 0.3))
    F, Q = motion_terms(np.stack([start, end]), np.stack([np.zeros(2), travel_m]), wheels)
    error = np.random.default_rng(0).standard_normal((3, 20000))
    error *= np.sqrt(np.multiply([1e-4, 3e-4, 2e-4], [*travel_m, travel_m.mean()]))[:, None]
    poses = se2.compose(start, arc_increment(travel_m + (error[:2] + error[2]).T, 0.3))
    sampled = np.cov(poses.T)
    scale = np.sqrt(np.outer(np.diag(sampled), np.diag(sampled)))
    np.testing.assert_allclose(Q[1] / scale, sampled / scale, atol=0.06)
    moved = [se2.compose(start + d, arc_increment(travel_m, 0.3)) for d in 1e-6 * np.eye(3)]
    np.testing.assert_allclose(F[1], ((np.array(moved) - end) / 1e-6).T, atol=1e-5)


@pytest.mark.parametrize("slip_m", [1e-6, 0.02])
def test_dead_reckoning_against_samples(slip_m: float) -> None:
    """With the greater slip, headings are lost on the way."""
    wheels = WheelNoise(np.array([slip_m, 2.0 * slip_m]), 0.0, 0.4)
    travel_m = np.tile([0.11, 0.1], (101, 1))
    travel_m[0] = 0.0
    steps, G = arc_increment(travel_m, 0.4), arc_increment_jacobian(travel_m, 0.4)
    start = np.diag([1e-4, 4e-4, 1e-4])
    least = bound_dead_reckoning(start, steps, G, wheels.covariances(travel_m))
    rng = np.random.default_rng(2)
    poses = rng.standard_normal((20000, 3)) * np.sqrt(np.diag(start))
    spread = np.sqrt(np.diag(wheels.covariances(travel_m)[1]))
    for _ in range(100):
        slips = rng.standard_normal((20000, 2)) * spread
        poses = se2.compose(poses, arc_increment(travel_m[1] + slips, 0.4))
    position = np.trace(np.cov(poses[:, :2].T))
    middle = np.arctan2(*np.array([np.sin(poses[:, 2]), np.cos(poses[:, 2])]).sum(axis=1))
    heading = np.square(se2.wrap(poses[:, 2] - middle)).mean()
    got = least[-1, 0, 0] + least[-1, 1, 1], least[-1, 2, 2]
    np.testing.assert_allclose(got, (position, heading), rtol=0.04)


@pytest.mark.parametrize("yaw", [0.0, 0.9])
def test_laser_against_dense_rays_and_finite_differences(yaw: float) -> None:
    laser = Laser(n_beams=61, fov_rad=4.0, sigma_range_m=0.03)
    mounted = dataclasses.replace(laser, mount=Mount(x_m=0.2, y_m=0.1, yaw_rad=yaw))
    poses = np.array([[0.3, -0.4, 0.5], [3.0, 1.0, -2.0]])
    at = se2.compose(poses, mounted.mount.pose)
    ranges = _ranges(mounted, at)
    given = laser_information(ROOM, mounted, poses, ranges)
    step = 1e-6 * np.eye(3)
    for k, pose in enumerate(poses):
        ahead = _ranges(mounted, se2.compose(pose + step, mounted.mount.pose))
        behind = _ranges(mounted, se2.compose(pose - step, mounted.mount.pose))
        slopes = (ahead - behind) / 2e-6
        np.testing.assert_allclose(given[k], slopes @ slopes.T / 0.03**2, rtol=1e-4, atol=1.0)
    bare = laser_information(ROOM, laser, poses, _ranges(laser, poses))
    for pose, information in zip(poses, bare, strict=True):
        dense = fisher_information(WALLS, pose, laser.bearings_rad, 0.03)
        np.testing.assert_allclose(information, dense, rtol=1e-6, atol=1e-3)


def test_beams_that_meet_people_tell_nothing() -> None:
    laser, poses = Laser(n_beams=31), np.array([[0.3, -0.4, 0.5]])
    ranges = _ranges(laser, poses)
    blocked = ranges.copy()
    blocked[:, 10:] -= 0.5
    fewer, all_ = (laser_information(ROOM, laser, poses, r)[0] for r in (blocked, ranges))
    assert np.linalg.eigvalsh(all_ - fewer).min() > 0.0
    assert not laser_information(ROOM, laser, poses, np.full_like(ranges, np.inf)).any()


def test_stereo_by_finite_differences() -> None:
    pose, landmark = np.array([0.5, -0.3, 0.4]), np.array([4.0, 1.5, 1.2])

    def image(q: Array, m: Array) -> Array:
        planar = CAMERA.mount.in_map(q)
        forward, left = se2.transform(se2.inverse(planar), m[None, :2])[0]
        scale = CAMERA.focal_px / forward
        row = -(m[2] - CAMERA.mount.z_m)
        return np.array([-left * scale, row * scale, CAMERA.baseline_m * scale])

    step = 1e-6 * np.eye(3)
    A = np.array([(image(pose + d, landmark) - image(pose - d, landmark)) / 2e-6 for d in step]).T
    B = np.array([(image(pose, landmark + d) - image(pose, landmark - d)) / 2e-6 for d in step]).T
    sigma = [CAMERA.sigma_column_px, CAMERA.sigma_row_px, CAMERA.sigma_disparity_px]
    weight = np.diag(1.0 / np.square(sigma))
    given = stereo_information(CAMERA, pose[None], landmark[None])
    for got, wanted in zip(
        given, (A.T @ weight @ A, A.T @ weight @ B, B.T @ weight @ B), strict=True
    ):
        np.testing.assert_allclose(got[0], wanted, rtol=1e-5, atol=1e-3)


def test_small_slam_against_marginals_of_gtsam() -> None:
    gtsam = pytest.importorskip("gtsam")
    chain = random_chain(np.random.default_rng(11), 8, seen=3)
    sights = chain.sights
    assert sights is not None
    graph = gtsam.GaussianFactorGraph()
    unit, zero = gtsam.noiseModel.Unit.Create(3), np.zeros(3)
    graph.add(0, np.linalg.cholesky(np.linalg.inv(chain.start)).T, zero, unit)
    for k in range(1, 8):
        W = np.linalg.cholesky(np.linalg.inv(chain.noise[k])).T
        graph.add(k - 1, -W @ chain.by_before[k], k, W, zero, unit)
    for row, landmark, cross, own in zip(*sights, strict=True):
        B = np.linalg.cholesky(own).T  # A = B^-T cross^T, so that A^T B is cross
        graph.add(int(row), np.linalg.solve(B.T, cross.T), 100 + int(landmark), B, zero, unit)
    values = gtsam.VectorValues()
    for key in itertools.chain(range(8), (100 + i for i in range(1 + int(sights.landmarks.max())))):
        values.insert(int(key), zero)
    marginals = gtsam.Marginals(graph, values)
    bound = bound_path(chain)
    for k in range(8):
        np.testing.assert_allclose(bound.revised[k], marginals.marginalCovariance(k), atol=1e-6)


def _ranges(laser: Laser, sensors: Array) -> Array:
    from sim.sensors.casting import SegmentCaster

    return SegmentCaster(ROOM, laser).cast_many(sensors)
