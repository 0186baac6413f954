"""Covariances of registration against repeated registrations and finite differences."""

from typing import get_args

import numpy as np
import pytest
from scipy.spatial import KDTree

from estimators.laser import icp_covariance
from estimators.laser.icp import DEFAULT_RULES, Plane, Rules, prepare, register
from estimators.laser.icp_covariance import UNKNOWN_M, UNKNOWN_RAD
from experiments.bench.icp import BEARINGS_RAD, SIGMA_RANGE_M, pair
from experiments.evaluation.scan_bound import cast
from sim import se2
from tests.estimators.laser.test_icp import BARE, ROOM, circle, scan

CORNER = np.array([[5.0, -100.0, 5.0, 3.0], [5.0, 3.0, -100.0, 3.0]])
OF_GUESS = np.diag([0.05**2, 0.05**2, 0.03**2])
AT = np.array([0.3, 0.4, 0.7])


@pytest.fixture
def rng():
    return np.random.default_rng(12)


def registered(walls, motion, rng, metric="point_to_line", at=AT, rules=DEFAULT_RULES):
    target = scan(walls, at, rng)
    source = scan(walls, se2.compose(at, motion), rng)
    return register(source, target, motion, metric=metric, rules=rules), source, target


def gradient_of(found, target):
    """Gradient of half the cost by the pose, matches and weights held, as NumPy would do it."""
    kept = found.inliers
    weights, matches = found.weights[kept], found.matches[kept]

    def gradient(pose, source_ranges, rays, lines, target_points):
        x, y, heading = pose
        points = source_ranges[kept, None] * rays[kept]
        moved = se2.transform(np.array([x, y, heading]), points)
        swing = np.column_stack([-(moved[:, 1] - y), moved[:, 0] - x])
        if found.metric == "point_to_line":
            m = lines[matches]
            n = m / np.linalg.norm(m, axis=1)[:, None]
            e = (np.sum(m * moved, axis=1) - 1.0) / np.linalg.norm(m, axis=1)
            J = np.column_stack([n, np.sum(n * swing, axis=1)])
            return J.T @ (weights * e)
        e = moved - target_points[matches]
        turn = np.sum(weights * np.sum(e * swing, axis=1))
        return np.append((weights[:, None] * e).sum(axis=0), turn)

    return gradient


@pytest.mark.parametrize("metric", ["point_to_line", "point_to_point"])
def test_derivatives(metric, rng):
    found, source, target = registered(ROOM, [0.05, 0.02, 0.03], rng, metric)
    A, by_source, by_target = icp_covariance._censi(
        source, target, found.T_target_source, metric == "point_to_line", False, found.matches,
        found.weights, found.residuals_m,
    )  # fmt: skip
    gradient = gradient_of(found, target)
    pose, step = found.T_target_source, 1e-6

    def at(pose=pose, ranges=source.ranges_m, lines=target.lines, target_ranges=target.ranges_m):
        points = target_ranges[:, None] * target.rays
        return gradient(pose, ranges, source.rays, lines, points)

    slope = [(at(pose + o) - at(pose - o)) / (2 * step) for o in step * np.eye(3)]
    np.testing.assert_allclose(A, np.stack(slope, axis=1), rtol=1e-5, atol=1e-6 * A.max())

    B = []
    for i in range(len(source.points)):
        ahead, behind = source.ranges_m.copy(), source.ranges_m.copy()
        ahead[i] += step
        behind[i] -= step
        B.append((at(ranges=ahead) - at(ranges=behind)) / (2 * step))
    B = np.array(B)
    np.testing.assert_allclose(by_source, B.T @ B, rtol=1e-5, atol=1e-6 * by_source.max())

    if metric == "point_to_line":
        expected = np.zeros((3, 3))
        for line, (s11, s12, s22) in enumerate(target.line_information):
            G = np.empty((3, 2))
            for k in range(2):
                ahead, behind = target.lines.copy(), target.lines.copy()
                ahead[line, k] += step
                behind[line, k] -= step
                G[:, k] = (at(lines=ahead) - at(lines=behind)) / (2 * step)
            expected += G @ np.linalg.inv([[s11, s12], [s12, s22]]) @ G.T
    else:
        B = []
        for i in range(len(target.points)):
            ahead, behind = target.ranges_m.copy(), target.ranges_m.copy()
            ahead[i] += step
            behind[i] -= step
            B.append((at(target_ranges=ahead) - at(target_ranges=behind)) / (2 * step))
        expected = np.array(B).T @ np.array(B)
    np.testing.assert_allclose(by_target, expected, rtol=1e-4, atol=1e-5 * by_target.max())


@pytest.mark.parametrize("plane", get_args(Plane))
def test_derivatives_of_point_to_plane(plane, rng):
    """By finite differences of the gradient, with matches, weights and normals held."""
    rules = Rules(plane=plane)
    found, source, target = registered(ROOM, [0.05, 0.02, 0.03], rng, "point_to_plane", rules=rules)
    A, by_source, by_target = icp_covariance._censi_planes(found, source, target)
    kept, step = found.inliers, 1e-6
    matches, weights = found.matches[kept], found.weights[kept]
    normals = found.planes.normals[matches]
    near = KDTree(target.points).query(target.points, k=6)[1][matches]
    members = near if plane == "centroid" else matches[:, None]

    def gradient(pose, source_m, target_m):
        q = se2.transform([0.0, 0.0, pose[2]], source_m[kept, None] * source.rays[kept])
        through = (target_m[:, None] * target.rays)[members].mean(axis=1)
        off = np.sum(normals * (q + pose[:2] - through), axis=1)
        lever = normals[:, 1] * q[:, 0] - normals[:, 0] * q[:, 1]
        return np.column_stack([normals, lever]).T @ (weights * off)

    at = [found.T_target_source, source.ranges_m, target.ranges_m]

    def slope(which):
        columns = []
        for k in range(len(at[which])):
            ends = []
            for sign in (step, -step):
                moved = [value.copy() for value in at]
                moved[which][k] += sign
                ends.append(gradient(*moved))
            columns.append((ends[0] - ends[1]) / (2.0 * step))
        return np.stack(columns, axis=1)

    np.testing.assert_allclose(A, slope(0), rtol=1e-4, atol=1e-6 * A.max())
    for products, which in ((by_source, 1), (by_target, 2)):
        B = slope(which)
        np.testing.assert_allclose(products, B @ B.T, rtol=1e-4, atol=1e-5 * products.max())


def test_information_of_a_line_is_that_of_its_fit(rng):
    """Refitting the lines of many noisy scans scatters them as their information says."""
    ranges = cast(CORNER, AT, BEARINGS_RAD)[0]
    fits = [
        prepare(ranges + SIGMA_RANGE_M * rng.standard_normal(721), BEARINGS_RAD) for _ in range(400)
    ]
    longest = [f for f in fits if len(f.lines) == 2]
    assert len(longest) > 300
    for line in (0, 1):
        sampled = np.cov(np.array([f.lines[line] for f in longest]).T)
        s11, s12, s22 = np.mean([f.line_information[line] for f in longest], axis=0)
        whitened = np.array([[s11, s12], [s12, s22]]) @ sampled / SIGMA_RANGE_M**2
        np.testing.assert_allclose(np.linalg.eigvals(whitened).real, 1.0, atol=0.3)


@pytest.mark.parametrize("place", ["room", "corner", "corridor"])
def test_point_to_line_against_many_registrations(place, rng):
    motion = np.array([0.1, 0.03, 0.05])
    if place == "corridor":
        p = pair("corridor", "small", 3)
        ranges, motion = (p.target_m, p.source_m), p.T_target_source
        # that pair has noise of its own: take it off by the fitted lines
        ranges = [icp_covariance._without_noise(prepare(r, BEARINGS_RAD)) for r in ranges]
        motion = register(*(prepare(r, BEARINGS_RAD) for r in ranges[::-1])).T_target_source
    else:
        walls = ROOM if place == "room" else CORNER
        ranges = [cast(walls, pose, BEARINGS_RAD)[0] for pose in (AT, se2.compose(AT, motion))]
    squares = {"both": [], "last": [], "hessian": []}
    for _ in range(250):
        target, source = (
            prepare(r + SIGMA_RANGE_M * rng.standard_normal(721), BEARINGS_RAD) for r in ranges
        )
        found = register(source, target, motion)
        off = found.T_target_source - motion
        for name in squares:
            if name == "hessian":
                P = icp_covariance.hessian(found)
            else:
                P = icp_covariance.censi(found, source, target, SIGMA_RANGE_M, scans=name)
            squares[name].append(off @ np.linalg.solve(P, off) / 3.0)
    anees = {name: np.mean(values) for name, values in squares.items()}
    assert 0.8 < anees["both"] < 1.25
    assert 1.5 < anees["last"] < 2.7  # half of the noise is left out
    assert 1.5 < anees["hessian"] < 2.9


def test_sampling_agrees_with_the_closed_form(rng):
    found, source, target = registered(ROOM, [0.1, 0.03, 0.05], rng)
    closed = icp_covariance.censi(found, source, target, SIGMA_RANGE_M)
    sampled = icp_covariance.sampling(found, source, target, rng, SIGMA_RANGE_M, n_samples=300)
    ratios = np.linalg.eigvals(np.linalg.solve(closed, sampled)).real
    assert np.all((ratios > 0.65) & (ratios < 1.5))


def test_unscented_is_the_spread_of_the_guess(rng):
    found, source, target = registered(ROOM, [0.1, 0.03, 0.05], rng)
    small = icp_covariance.unscented(found, source, target, OF_GUESS)
    assert np.all(np.linalg.eigvalsh(small) > -1e-15)
    assert np.sqrt(np.trace(small)) < 1e-3  # in a room any such guess leads to the same place
    closed = icp_covariance.censi(found, source, target, SIGMA_RANGE_M)
    both = icp_covariance.unscented_censi(found, source, target, OF_GUESS, SIGMA_RANGE_M)
    np.testing.assert_allclose(both, small + closed, rtol=1e-9, atol=1e-15)
    # from a corridor's bare walls the guess comes back along them
    found, source, target = registered(BARE, [0.1, 0.0, 0.02], rng, at=np.zeros(3))
    spread = icp_covariance._spread(found, source, target, OF_GUESS, None, {})
    assert spread[0, 0] == pytest.approx(OF_GUESS[0, 0], rel=0.3)
    assert max(spread[1, 1], spread[2, 2]) < 1e-6


def test_sliding_matches_make_point_to_point_credible(rng):
    motion = np.array([0.05, 0.02, 0.03])
    squares = {"held": [], "sliding": []}
    for _ in range(60):
        found, source, target = registered(ROOM, motion, rng, "point_to_point")
        off = found.T_target_source - motion
        for name in squares:
            P = icp_covariance.censi(found, source, target, SIGMA_RANGE_M, matches=name)
            squares[name].append(off @ np.linalg.solve(P, off) / 3.0)
    assert np.mean(squares["held"]) > 50.0  # range noise has no lever on the heading
    assert np.mean(squares["sliding"]) < 5.0


METHODS = {
    "censi": lambda f, s, t, rng: icp_covariance.censi(f, s, t),
    "last": lambda f, s, t, rng: icp_covariance.censi(f, s, t, scans="last"),
    "sliding": lambda f, s, t, rng: icp_covariance.censi(f, s, t, matches="sliding"),
    "hessian": lambda f, s, t, rng: icp_covariance.hessian(f),
    "sampling": lambda f, s, t, rng: icp_covariance.sampling(f, s, t, rng, n_samples=5),
    "unscented": lambda f, s, t, rng: icp_covariance.unscented(f, s, t, OF_GUESS),
    "unscented_censi": lambda f, s, t, rng: icp_covariance.unscented_censi(f, s, t, OF_GUESS),
}


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("metric", ["point_to_line", "point_to_point"])
def test_what_is_not_held_is_never_confident(name, metric, rng):
    method = METHODS[name]
    for P in (
        method(*registered(circle(4.0), [0.05, 0.0, 0.1], rng, metric, np.zeros(3)), rng),
        method(*registered(circle(1.5), [0.0, 0.02, 0.0], rng, metric, np.zeros(3)), rng),
    ):
        assert P[2, 2] > 0.5 * UNKNOWN_RAD**2
        assert max(P[0, 0], P[1, 1]) < 0.1 * UNKNOWN_M**2
        np.testing.assert_array_equal(P, P.T)
        assert np.all(np.linalg.eigvalsh(P) > -1e-9)
    P = method(*registered(BARE, [0.1, 0.0, 0.05], rng, metric, np.zeros(3)), rng)
    assert P[0, 0] > 0.5 * UNKNOWN_M**2
    assert P[1, 1] < 0.05**2
    assert P[2, 2] < 0.02**2
    empty = prepare(np.full(721, np.inf), BEARINGS_RAD)
    room = scan(ROOM, AT, rng)
    lost = scan(ROOM, se2.compose(AT, [0.0, 0.0, np.pi]), rng)
    for source in (empty, lost):
        P = method(register(source, room, metric=metric), source, room, rng)
        if source is empty or metric == "point_to_line":
            np.testing.assert_array_equal(P, np.diag([UNKNOWN_M**2] * 2 + [UNKNOWN_RAD**2]))


def test_covariance_turns_with_the_sensor(rng):
    p, yaw = pair("room", "small", 5), 0.7
    plain, turned = (
        (prepare(p.source_m, BEARINGS_RAD + y), prepare(p.target_m, BEARINGS_RAD + y))
        for y in (0.0, yaw)
    )
    c, s = np.cos(yaw), np.sin(yaw)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    for scans in ("both", "last"):
        P = icp_covariance.censi(register(*plain), *plain, scans=scans)
        Q = icp_covariance.censi(register(*turned), *turned, scans=scans)
        np.testing.assert_allclose(Q, R @ P @ R.T, rtol=1e-3, atol=1e-4 * P.max())
    found = register(*plain)
    np.testing.assert_allclose(
        icp_covariance.censi(found, *plain, 0.02), 4.0 * icp_covariance.censi(found, *plain, 0.01)
    )


@pytest.mark.parametrize("walls", [ROOM, BARE])
def test_the_derivative_by_a_bias_is_that_of_registrations_of_biased_scans(walls):
    """By 2 cm, and by 1 % of the range; along a corridor nothing is said."""
    at, ahead = np.array([0.3, 0.2, 0.1]), np.array([0.5, 0.15, 0.2])
    true = se2.between(at, ahead)

    def scans(length_m, share):
        return [
            prepare(
                (1.0 + share) * cast(walls, pose, BEARINGS_RAD)[0] + length_m, BEARINGS_RAD, 80.0
            )
            for pose in (ahead, at)
        ]

    source, target = scans(0.0, 0.0)
    found = register(source, target, true)
    slopes = icp_covariance.by_bias(found, source, target)
    for column, (length_m, share) in enumerate([(0.02, 0.0), (0.0, 0.01)]):
        off = register(*scans(length_m, share), true).T_target_source - found.T_target_source
        expected = slopes[:, column] * (length_m + share)
        held = found.status == "ok"
        assert np.abs(off - expected)[1 - held :].max() < 0.25 * np.abs(off).max() + 1e-4, column
