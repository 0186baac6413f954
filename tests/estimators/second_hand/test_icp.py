"""ICP of decristoforis2020, secs. II-C and III, written out in plain NumPy from the paper.

Nothing of the product is used but what is tested: not its scans, its matching or its geometry.
"""

import math

import numpy as np
import pytest

from estimators.laser import icp_covariance, icp_iterations, icp_start
from estimators.laser.icp import Rules, prepare, register
from tests.fixtures.derivatives import slope

BEARINGS_RAD = np.linspace(-np.pi / 2, np.pi / 2, 241)
ARMS = ["point_to_point", "matched_point", "centroid"]  # the metrics, and planes of the second


def random_room(rng):
    """Two noisy scans (N,) m in a room of random size, and the motion between them."""
    size, at = rng.uniform(4.0, 8.0, 2), rng.uniform(1.5, 2.5, 2)
    motion = np.append(rng.uniform(-0.1, 0.1, 2), rng.uniform(-0.05, 0.05))
    heading = rng.uniform(-np.pi, np.pi)
    scans = []
    for pose in (np.zeros(3), motion):
        c, s = math.cos(heading), math.sin(heading)
        x, y = at + np.array([[c, -s], [s, c]]) @ pose[:2]
        angle = heading + pose[2] + BEARINGS_RAD
        dx, dy = np.cos(angle), np.sin(angle)
        to_x = np.where(dx > 0, size[0] - x, -x) / dx
        to_y = np.where(dy > 0, size[1] - y, -y) / dy
        scans.append(np.minimum(to_x, to_y) + 0.01 * rng.standard_normal(len(angle)))
    return *scans, motion


def cloud(ranges):
    return ranges[:, None] * np.column_stack([np.cos(BEARINGS_RAD), np.sin(BEARINGS_RAD)])


def moved(pose, points):
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return points @ np.array([[c, s], [-s, c]]) + pose[:2]


def nearest(points, others, k=1):
    """Numbers (N, k) of the k points of `others` nearest to each point."""
    squares = ((points[:, None] - others[None]) ** 2).sum(axis=2)
    return np.argsort(squares, axis=1)[:, :k]


def planes(target, arm, k=6):
    """Normal and a point of the plane at each point: of it and its k - 1 nearest neighbours."""
    near = target[nearest(target, target, k)]
    off = near - near.mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", off, off))[1][:, :, 0]
    return normals, target if arm == "matched_point" else near.mean(axis=1)


def errors(pose, source, target, j, arm, normals, through):
    """Distances of the source's points from what they are matched with: E of sec. II-C is e @ e."""
    off = moved(pose, source) - (target[j] if arm == "point_to_point" else through[j])
    return off.ravel() if arm == "point_to_point" else np.sum(off * normals[j], axis=1)


def printed_steps(source, target, pose, arm, n):
    """Steps 1 to 4 of sec. II-C, n times; step 2 by Gauss and Newton. Yields each pose."""
    normals, through = planes(target, arm)
    for _ in range(n):
        j = nearest(moved(pose, source), target)[:, 0]
        of_pose = lambda p: errors(p, source, target, j, arm, normals, through)  # noqa: B023, E731
        pose = pose - np.linalg.lstsq(slope(of_pose, pose), of_pose(pose))[0]
        yield pose


def kabsch(source, target):
    """The transformation of least E in closed form (Besl and McKay), point to point."""
    a, b = source.mean(axis=0), target.mean(axis=0)
    U, _, Vt = np.linalg.svd((source - a).T @ (target - b))
    R = Vt.T @ np.diag([1.0, np.linalg.det(Vt.T @ U.T)]) @ U.T
    return np.append(b - R @ a, math.atan2(R[1, 0], R[0, 0]))


def aligned(scans, of_planes, start, n):
    """Pose after n iterations of the product, all points alike; planes None: point to point."""
    surface, many = icp_start.as_segments(scans[1]), len(scans[0].points)
    planes_at = surface
    if of_planes is not None:
        planes_at = surface._replace(normals=of_planes[0], distances_m=of_planes[1])
    pair = icp_iterations.Pair(*scans, False, of_planes is not None, surface, planes_at, 0.01)
    every = icp_iterations.Sample(np.arange(many), np.ones(many))
    plain = icp_iterations.Stage(False, True, math.inf, math.inf, math.inf, 0.0)  # no weights
    settings = icp_iterations.Settings(n, 0.0, 0.0, 1e-5, 1e-5, 0.0, 0.0, np.zeros((3, 3)))
    fit = icp_iterations.Fit(np.zeros(many, np.int64), np.zeros(many), np.zeros(many))
    pose = start.copy()
    icp_iterations.align(pair, settings, plain, every, start, pose, fit)
    return pose


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("seed", range(4))
def test_each_iteration_is_the_printed_one(arm, seed):
    rng = np.random.default_rng(seed)
    target_m, source_m, motion = random_room(rng)
    target, source = cloud(target_m), cloud(source_m)
    scans = [prepare(ranges, BEARINGS_RAD) for ranges in (source_m, target_m)]
    of_planes = None
    if arm != "point_to_point":
        of_planes = icp_start.planes_of(scans[1].points, 6, through_centroid=arm == "centroid")
    start = motion + np.append(rng.normal(0.0, 0.01, 2), rng.normal(0.0, 0.005))
    for n, expected in enumerate(printed_steps(source, target, start, arm, 8), 1):
        np.testing.assert_allclose(aligned(scans, of_planes, start, n), expected, atol=2e-6)
    if arm == "point_to_point":  # both ways of step 2 come to rest at the same place
        closed = start
        for _ in range(60):
            closed = kabsch(source, target[nearest(moved(closed, source), target)[:, 0]])
        *_, newton = printed_steps(source, target, start, arm, 60)
        np.testing.assert_allclose(newton, closed, atol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_open3d_puts_its_planes_through_the_matched_points(seed):
    """Its step of point to plane, over the same matches and normals, is ours."""
    open3d = pytest.importorskip("open3d", reason="Open3D is not installed")
    rng = np.random.default_rng([seed, 4])
    target_m, source_m, motion = random_room(rng)
    source, target = cloud(source_m), cloud(target_m)
    scans = [prepare(ranges, BEARINGS_RAD) for ranges in (source_m, target_m)]
    found = icp_start.planes_of(scans[1].points, 6, through_centroid=False)
    j = nearest(moved(motion, source), target)[:, 0]
    # walls of two heights, and a floor in both, hold what the plane leaves free
    floor = np.column_stack([rng.uniform(-3.0, 3.0, (40, 2)), np.zeros(40)])
    at = moved(motion, source)
    clouds = []
    for walls in (at, target):
        layers = [np.pad(walls, ((0, 0), (0, 1)), constant_values=z) for z in (-1.0, 1.0)]
        points = open3d.utility.Vector3dVector(np.concatenate([*layers, floor]))
        clouds.append(open3d.geometry.PointCloud(points))
    level = np.pad(found.normals, ((0, 0), (0, 1)))
    up = np.tile([0.0, 0.0, 1.0], (40, 1))
    clouds[1].normals = open3d.utility.Vector3dVector(np.concatenate([level, level, up]))
    n = len(source)
    pairs = [(i + k * n, j[i] + k * n) for k in range(2) for i in range(n)]
    pairs += [(2 * n + i, 2 * n + i) for i in range(40)]
    way = open3d.pipelines.registration.TransformationEstimationPointToPlane()
    T = way.compute_transformation(*clouds, open3d.utility.Vector2iVector(np.array(pairs)))
    theirs = T[:2, :2] @ moved(motion, np.zeros((1, 2)))[0] + T[:2, 3]
    turn = math.atan2(T[1, 0], T[0, 0])
    np.testing.assert_allclose(
        aligned(scans, found, motion, 1), [*theirs, motion[2] + turn], atol=1e-5
    )


@pytest.mark.slow
@pytest.mark.parametrize("arm", ARMS)
def test_a_registration_rests_where_the_printed_iterations_do(arm):
    """With weights all alike; the product's gates and stages leave the minimum where it is."""
    metric = "point_to_point" if arm == "point_to_point" else "point_to_plane"
    rules = Rules(kernel="none", plane="centroid" if arm == "centroid" else "matched_point")
    off = []
    for seed in range(10):
        target_m, source_m, motion = random_room(np.random.default_rng([seed, 1]))
        source, target = (prepare(r, BEARINGS_RAD) for r in (source_m, target_m))
        found = register(source, target, motion, metric=metric, rules=rules)
        *_, expected = printed_steps(cloud(source_m), cloud(target_m), motion, arm, 60)
        off.append(np.abs(found.T_target_source - expected).max())
    assert np.mean(np.array(off) < 5e-5) >= 0.8  # a match may flip between two rests
    assert np.max(off) < 5e-3


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("seed", range(3))
def test_covariance_is_that_of_eqs_6_to_8(arm, seed):
    """E of sec. III is differentiated by differences; z is the last scan's ranges."""
    target_m, source_m, motion = random_room(np.random.default_rng([seed, 2]))
    source, target = (prepare(r, BEARINGS_RAD) for r in (source_m, target_m))
    metric = "point_to_point" if arm == "point_to_point" else "point_to_plane"
    rules = Rules(plane="centroid" if arm == "centroid" else "matched_point")
    found = register(source, target, motion, metric=metric, rules=rules)
    points, j = cloud(target_m), found.matches
    normals, through = planes(points, arm)
    near = nearest(points, points, 6 if arm == "centroid" else 1)
    used = found.weights > 0.0
    weights = np.repeat(found.weights[used], 2 if arm == "point_to_point" else 1)

    def gradient(x, z, other):
        """Of E by x, for ranges z of the last scan and of the other."""
        here = cloud(other)
        at = through + (here - points)[near].mean(axis=1)  # normals held
        args = cloud(z)[used], here, j[used], arm, normals, at
        e = errors(x, *args)
        return 2.0 * slope(lambda p: errors(p, *args), x).T @ (weights * e)

    x, sigma, step = found.T_target_source, 0.01, 1e-4
    by_x = slope(lambda p: gradient(p, source_m, target_m), x, step)  # d2E/dx2
    beams = step * np.eye(len(source_m))
    by_last, by_other = (
        np.array(
            [
                gradient(x, source_m + w * (k == 0), target_m + w * (k == 1))
                - gradient(x, source_m - w * (k == 0), target_m - w * (k == 1))
                for w in beams
            ]
        ).T
        / (2.0 * step)
        for k in range(2)
    )
    inverse = np.linalg.inv(by_x)
    expected = sigma**2 * inverse @ by_last @ by_last.T @ inverse  # eq. (8)
    both = expected + sigma**2 * inverse @ by_other @ by_other.T @ inverse  # as Censi published it
    for scans, printed in (("last", expected), ("both", both)):
        formula = icp_covariance.censi(found, source, target, sigma, scans=scans, everywhere=True)
        scale = np.sqrt(np.outer(np.diag(printed), np.diag(printed)))
        np.testing.assert_allclose(formula / scale, printed / scale, atol=2e-3)
    assert np.linalg.det(both) > 2.0 * np.linalg.det(expected)
