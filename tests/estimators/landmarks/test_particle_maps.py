"""Landmark filters in batches, against plain NumPy."""

import itertools
import math

import numpy as np
import pytest
from scipy import stats

from estimators.landmarks import particle_kernels as ekf
from estimators.landmarks.particle_kernels import LANES
from estimators.landmarks.particle_maps import LandmarkMaps
from estimators.landmarks.stereo import StereoModel
from estimators.particles import keep_survivors
from sim import se2
from sim.sensors import Mount, StereoCamera

CAMERA = StereoCamera(mount=Mount(x_m=0.2, y_m=-0.1, z_m=0.6, yaw_rad=0.3))
MODELS = list(itertools.product(["diagonal", "correlated", "image"], ["predicted", "measured"]))
N_PARTICLES = 20  # more than one block, and not a multiple of LANES


class Batch:
    """Random poses and landmarks before them, as the compiled loops take them."""

    def __init__(self, noise_model="image", noise_at="predicted", n_slots=3, seed=0):
        rng = np.random.default_rng(seed)
        self.model = StereoModel.of(CAMERA, noise_model, noise_at)
        self.camera = self.model.packed
        self.maps = LandmarkMaps(N_PARTICLES, "contiguous", births=False)
        n_lanes = self.maps.n_blocks * LANES
        x, y, heading = rng.normal([[1.0], [2.0], [0.5]], 0.1, (3, n_lanes))
        self.lanes = np.stack([x, y, heading, np.cos(heading), np.sin(heading)])
        self.state = ekf.new_state(self.maps.n_blocks)
        self.rolled(np.zeros((3, n_lanes)), np.eye(3))
        self.poses = self.lanes[:3, :N_PARTICLES].T
        self.points = rng.uniform([-1.0, -0.5, 2.0], [1.0, 0.5, 6.0], (n_slots, 3))
        self.maps.reserve(n_slots)
        self.maps.counts[:] = n_slots
        self.means = self.model.place(np.array([1.0, 2.0, 0.5]), self.points)
        self.means = self.means + rng.normal(0, 0.05, (N_PARTICLES, n_slots, 3))
        factor = rng.normal(0, 0.2, (N_PARTICLES, n_slots, 3, 3))
        self.covariances = factor @ factor.swapaxes(-1, -2) + 1e-3 * np.eye(3)
        self.write()

    def rolled(self, normals, root):
        x, y, yaw = self.model.mount
        mount = np.array([x, y, math.cos(yaw), math.sin(yaw)])
        return ekf.move(self.lanes, np.zeros(3), root, normals, mount, self.state)

    def write(self):
        numbers = self.maps.data.reshape(len(self.maps.data), -1, 9, LANES)
        rows, columns = np.triu_indices(3)
        for m, slot in itertools.product(range(N_PARTICLES), range(len(self.points))):
            at = numbers[self.maps.place[slot], m // LANES, :, m % LANES]
            at[:3] = self.means[m, slot]
            at[3:] = self.covariances[m, slot][rows, columns]

    @property
    def rows(self):
        return self.maps.rows(np.arange(len(self.points)))

    def sums(self):
        logs = ekf.log_weights(self.state, N_PARTICLES)
        return logs + ekf.log_scale(self.points, self.camera)


def innovation(batch, m, slot):
    """v, S, H by pose, G by landmark, in the camera frame."""
    predicted, by_pose, by_landmark = batch.model.predict(batch.poses[m], batch.means[m, slot])
    v, R = batch.model.innovation(predicted, batch.points[slot])
    S = by_landmark @ batch.covariances[m, slot] @ by_landmark.T + R
    return v, S, by_pose, by_landmark, R, predicted


@pytest.mark.parametrize(("noise_model", "noise_at"), MODELS)
def test_update_is_the_joseph_form_and_weighs_by_the_density(noise_model, noise_at):
    batch = Batch(noise_model, noise_at)
    ekf.update(batch.maps.data, batch.rows, batch.points, batch.state, batch.camera)
    gained = batch.sums()
    for m in range(N_PARTICLES):
        means, covariances, _ = batch.maps.of_particle(m)
        expected = 0.0
        for slot in range(len(batch.points)):
            v, S, _, G, R, predicted = innovation(batch, m, slot)
            K = batch.covariances[m, slot] @ G.T @ np.linalg.inv(S)
            left = np.eye(3) - K @ G
            joseph = left @ batch.covariances[m, slot] @ left.T + K @ R @ K.T
            assert np.allclose(means[slot], batch.means[m, slot] + K @ v, atol=1e-11)
            assert np.allclose(covariances[slot], joseph, rtol=1e-9, atol=1e-12)
            expected += stats.multivariate_normal.logpdf(v, cov=S)
            if noise_model == "image" and noise_at == "predicted":
                expected -= 4.0 * math.log(batch.points[slot, 2] / predicted[2])
        assert gained[m] == pytest.approx(expected, abs=1e-9)


def test_each_particle_its_own_slots_gives_the_same():
    together, apart = Batch(), Batch()
    ekf.update(together.maps.data, together.rows, together.points, together.state, together.camera)
    slots = np.tile(apart.rows[:, None], (1, N_PARTICLES))
    slots[1, 3] = -1
    ekf.update_each(apart.maps.data, slots, apart.points, apart.state, apart.camera)
    others = np.arange(N_PARTICLES) != 3
    assert np.allclose(together.sums()[others], apart.sums()[others], rtol=1e-12)
    assert np.array_equal(apart.maps.of_particle(3)[0][1], apart.means[3, 1])
    assert not np.array_equal(apart.maps.of_particle(3)[0][2], apart.means[3, 2])
    for m in np.flatnonzero(others):
        for first, second in zip(
            together.maps.of_particle(m), apart.maps.of_particle(m), strict=True
        ):
            assert np.allclose(first, second, rtol=1e-11)
    ekf.inform(together.maps.data, together.rows, together.points, together.state, together.camera)
    ekf.inform_each(apart.maps.data, slots, apart.points, apart.state, apart.camera)


@pytest.mark.parametrize("noise_model", ["diagonal", "image"])
def test_new_landmarks_take_the_measurements_covariance(noise_model):
    """gil2008, eq. (18), is the information: what holds is (G^T R^-1 G)^-1."""
    batch = Batch(noise_model)
    slots = np.tile(batch.rows[:, None], (1, N_PARTICLES))
    slots[0, 5] = -1
    ekf.create(batch.maps.data, slots, batch.points, batch.state, batch.camera)
    for m in (0, 5, N_PARTICLES - 1):
        means, covariances, _ = batch.maps.of_particle(m)
        G = batch.model.axes(batch.poses[m])[1]
        for slot in range(1 if m == 5 else 0, len(batch.points)):
            R = batch.model.covariance(batch.points[slot])
            information = G.T @ np.linalg.inv(R) @ G
            assert np.allclose(covariances[slot] @ information, np.eye(3), atol=1e-7)
            assert np.allclose(means[slot], batch.model.place(batch.poses[m], batch.points[slot]))
    assert np.array_equal(batch.maps.of_particle(5)[0][0], batch.means[5, 0])


@pytest.mark.parametrize(("noise_model", "noise_at"), MODELS)
def test_proposal_is_the_motion_given_the_image(noise_model, noise_at):
    batch = Batch(noise_model, noise_at)
    root = np.array([[0.05, 0.0, 0.01], [0.0, 0.03, 0.0], [0.02, 0.04, 0.03]])
    n_lanes = batch.lanes.shape[1]
    noise = np.random.default_rng(3).standard_normal((3, n_lanes))
    ekf.inform(batch.maps.data, batch.rows, batch.points, batch.state, batch.camera)
    drawn, middle = noise.copy(), np.zeros((3, n_lanes))
    owed, at_middle = np.empty((2, n_lanes)), np.empty((2, n_lanes))
    start = 0.1 * np.random.default_rng(4).standard_normal((3, n_lanes))
    stretch = np.random.default_rng(5).uniform(0.5, 3.0, n_lanes)
    ekf.propose(batch.lanes, root, stretch, batch.state, start, drawn, owed)
    ekf.propose(batch.lanes, root, stretch, batch.state, start, middle, at_middle)
    for m in range(N_PARTICLES):
        cos, sin = batch.lanes[3:, m]
        B = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ root * stretch[m]
        inverse, rhs = np.eye(3), np.zeros(3)
        for slot in range(len(batch.points)):
            v, S, H, _, _, _ = innovation(batch, m, slot)
            inverse += (H @ B).T @ np.linalg.solve(S, H @ B)
            rhs += (H @ B).T @ np.linalg.solve(S, v + H @ B @ start[:, m])
        P = np.linalg.inv(inverse)
        assert np.allclose(middle[:, m], P @ rhs, atol=1e-8)
        off = drawn[:, m] - middle[:, m]
        assert off @ inverse @ off == pytest.approx(noise[:, m] @ noise[:, m], rel=1e-8)
        log_p = stats.multivariate_normal.logpdf(drawn[:, m], cov=np.eye(3))
        log_q = stats.multivariate_normal.logpdf(drawn[:, m], P @ rhs, P)
        weight = 0.5 * owed[0, m] - math.log(owed[1, m])
        assert weight == pytest.approx(log_p - log_q, abs=1e-8)


def test_covariances_stay_positive_definite():
    """A landmark seen first from afar and then ten thousand times from near."""
    batch = Batch("correlated", n_slots=1)
    batch.points[0] = 0.0, 0.0, 0.4
    batch.means[:] = batch.model.place(batch.poses, batch.points[[0]])[:, None]
    batch.covariances[:] = np.diag([100.0, 1e-4, 1e-2])
    batch.write()
    for _ in range(10_000):
        ekf.update(batch.maps.data, batch.rows, batch.points, batch.state, batch.camera)
    for m in range(N_PARTICLES):
        covariance = batch.maps.of_particle(m)[1][0]
        assert np.array_equal(covariance, covariance.T)
        assert np.linalg.eigvalsh(covariance)[0] > 0.0


def test_many_observations_stay_within_a_double():
    """All landmarks of a group were last seen from 40 m, and are 2 to 6 m away."""
    batch = Batch("image", n_slots=ekf.GROUP)
    batch.covariances[:] = batch.model.covariance(np.array([0.0, 0.0, 40.0]))[[2, 0, 1]][
        :, [2, 0, 1]
    ]
    batch.write()
    ekf.update(batch.maps.data, batch.rows, batch.points, batch.state, batch.camera)
    assert np.isfinite(batch.sums()).all()


@pytest.mark.parametrize("maps", ["shared", "contiguous"])
def test_maps_follow_the_ancestry(maps):
    """Against plain lists that are copied whole, over more generations than are kept."""
    rng = np.random.default_rng(1)
    n, n_slots = 20, 12
    ours = LandmarkMaps(n, maps, births=True)
    ours.reserve(n_slots)
    ours.counts[:] = n_slots
    theirs = np.zeros((n_slots, n))
    carried = np.zeros((n_slots, n), np.int64)
    numbers = ours.data.reshape(len(ours.data), -1, 9, LANES)
    m = np.arange(n)
    for generation in range(600):
        ancestors = keep_survivors(rng.integers(n, size=n), n)
        ours.resample(ancestors)
        theirs, carried = theirs[:, ancestors], carried[:, ancestors]
        touched = rng.choice(n_slots - 1, 2, replace=False)  # the last slot only in the end
        ours.touch(touched)
        for slot in touched:
            values = rng.standard_normal(n)
            numbers[ours.place[slot], m // LANES, :, m % LANES] = values[:, None]
            ours.births[slot] = generation * n + m
            theirs[slot], carried[slot] = values, ours.births[slot]
        if generation % 150 == 0:
            for particle in (0, 7, n - 1):
                assert np.array_equal(ours.of_particle(particle)[0][:, 0], theirs[:, particle])
    ours.touch(np.arange(n_slots))
    for particle in range(n):
        means, _, births = ours.of_particle(particle)
        assert np.array_equal(means[:, 0], theirs[:, particle])
        assert np.array_equal(births, carried[:, particle])


def test_shared_maps_do_not_copy_what_is_not_touched():
    ours = LandmarkMaps(N_PARTICLES, "shared", births=False)
    ours.reserve(5)
    ours.counts[:] = 5
    before = ours.data.copy()
    ours.resample(np.zeros(N_PARTICLES, np.int64))
    assert np.array_equal(ours.data, before)


def brute_force(batch, m, points, threshold, spread_in_map, unlikeness=None):
    taken, slots = set(), []
    for i, point in enumerate(points):
        best, chosen = math.inf, -1
        for slot in range(batch.maps.counts[m]):
            predicted, H, G = batch.model.predict(batch.poses[m], batch.means[m, slot])
            v, R = batch.model.innovation(predicted, point)
            S = G @ batch.covariances[m, slot] @ G.T + R + H @ spread_in_map @ H.T
            distance = v @ np.linalg.solve(S, v)
            like = 0.0 if unlikeness is None else unlikeness[i, slot]
            if slot in taken or like > 0.0 or distance >= threshold:
                continue
            if distance + like < best:
                best, chosen = distance + like, slot
        taken.add(chosen)
        slots.append(chosen)
    return slots


@pytest.mark.parametrize("described", [False, True])
def test_association_is_the_least_distance_of_each_particle(described):
    rng = np.random.default_rng(5)
    batch = Batch("correlated", n_slots=8)
    batch.maps.counts[4] = 5
    points = batch.points[rng.permutation(8)[:6]] + rng.normal(0, 0.3, (6, 3))
    births = np.tile(np.arange(8)[:, None], (1, N_PARTICLES))
    unlikeness = rng.normal(-3.0, 3.0, (6, 8)) if described else np.zeros((6, 0))
    spread = np.array([[0.02, 0.005, 0.001], [0.005, 0.01, 0.002], [0.001, 0.002, 0.003]])
    candidates = batch.maps.nearby(batch.state, 20.0)
    assert np.array_equal(candidates, np.arange(8))
    slots = ekf.associate(
        batch.maps.data,
        ekf.Candidates(candidates, batch.maps.place, batch.maps.counts, births),
        points,
        unlikeness,
        spread,
        12.0,
        batch.state,
        batch.camera,
    )
    for m in range(N_PARTICLES):
        angle = batch.poses[m, 2] + batch.model.mount[2]
        cos, sin = math.cos(angle), math.sin(angle)
        turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
        in_map = turn @ spread @ turn.T
        expected = brute_force(batch, m, points, 12.0, in_map, unlikeness if described else None)
        assert slots[:, m].tolist() == expected
    assert len(np.unique(slots)) > 3
    assert np.any(slots < 0)


def test_nearby_are_those_before_some_camera_within_reach():
    batch = Batch(n_slots=8)
    batch.means[:, :3] -= [8.0, 0.0, 0.0]  # behind all cameras
    batch.means[3, 1] += [8.0, 0.0, 0.0]  # but for one
    batch.means[:, 4] += [30.0, 0.0, 0.0]
    batch.maps.counts[:] = 7
    batch.write()
    expected = np.zeros(8, bool)
    for m in range(N_PARTICLES):
        position, C = batch.model.axes(batch.poses[m])
        off = batch.means[m] - position
        within = (off @ C[2] > 0.0) & (np.hypot(off[:, 0], off[:, 1]) < 10.0)
        expected |= within & (np.arange(8) < 7)
    found = batch.maps.nearby(batch.state, 10.0)
    assert np.array_equal(found, np.flatnonzero(expected))
    assert found.tolist() == [1, 3, 5, 6]


def test_poses_move_by_the_increment_and_its_noise():
    batch, rng = Batch(), np.random.default_rng(6)
    root, increment = rng.normal(0.0, 0.1, (3, 3)), np.array([0.4, 0.1, 3.0])
    normals = rng.standard_normal((3, batch.lanes.shape[1]))
    mount = np.array([*batch.model.mount[:2], 1.0, 0.0])
    moved = ekf.move(batch.lanes, increment, root, normals, mount, batch.state)
    steps = increment + (root @ normals).T
    for pose, found, step in zip(batch.lanes[:3].T, moved.T, steps, strict=True):
        expected = se2.compose(pose, step)
        heading = expected[2]
        assert np.allclose(
            [*found[:2], se2.wrap(found[2]), *found[3:]],
            [*expected, np.cos(heading), np.sin(heading)],
            atol=1e-12,
        )


def test_moments_are_those_of_numpy():
    rng = np.random.default_rng(2)
    poses = rng.normal([1e3, -5.0, math.pi], [1.0, 2.0, 0.2], (50, 3))
    poses[:, 2] = np.angle(np.exp(1j * poses[:, 2]))
    weights = rng.random(50)
    weights /= weights.sum()
    mean, covariance = ekf.moments(poses, weights)
    heading = np.angle(weights @ np.exp(1j * poses[:, 2]))
    assert np.allclose(mean, [*(weights @ poses[:, :2]), heading])
    off = poses - mean
    off[:, 2] = np.angle(np.exp(1j * off[:, 2]))
    assert np.allclose(covariance, off.T @ (off * weights[:, None]))
