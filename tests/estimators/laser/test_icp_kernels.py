"""Each compiled part of a registration against a few lines of plain NumPy."""

import math

import numpy as np
import pytest
from scipy.spatial import KDTree

from estimators.laser import icp_iterations, icp_judgement, icp_start, scan_lines
from estimators.laser.icp import prepare
from experiments.bench.icp import BEARINGS_RAD, pair
from sim import se2

POSE = np.array([0.04, -0.03, 0.02])
TO_LINES = pytest.mark.parametrize("to_lines", [True, False])


@pytest.fixture(params=[("room", 1), ("corridor", 2)], ids=["room", "corridor"], scope="module")
def scans(request):
    p = pair(request.param[0], "small", request.param[1])
    return prepare(p.source_m, BEARINGS_RAD), prepare(p.target_m, BEARINGS_RAD)


def pair_of(scans, to_lines):
    source, target = scans
    surface = target.segments if to_lines else icp_start.as_segments(target)
    noise_m = max(source.noise_m, target.noise_m)
    return icp_iterations.Pair(source, target, to_lines, to_lines, surface, surface, noise_m)


def fit_at(pair, pose=POSE):
    """A fit whose matches are the nearest, and the squared misses."""
    n = len(pair.source.points)
    fit, misses = icp_iterations.Fit(np.zeros(n, np.int64), np.zeros(n), np.zeros(n)), np.empty(n)
    every = icp_iterations.Sample(np.arange(n), np.linspace(0.5, 2.0, n))
    icp_iterations._match(pair, math.inf, every, pose, True, fit, misses)
    return fit, misses, every


def jacobian(normals, points):
    """Derivative of the distances along normals (K, 2) by the pose, of points about it."""
    lever = normals[:, 1] * points[:, 0] - normals[:, 0] * points[:, 1]
    return np.column_stack([normals, lever])


def turned(angle, vectors):
    return se2.transform(np.array([0.0, 0.0, angle]), vectors)


def full(lower):
    return np.tril(lower) + np.tril(lower, -1).T


def test_ranked_is_the_sorted_value():
    rng = np.random.default_rng(0)
    for n in (1, 2, 3, 50, 51):
        values = rng.integers(0, 20, n).astype(float)
        values[rng.random(n) < 0.1] = np.inf
        assert [scan_lines.select(values, k) for k in range(n)] == sorted(values)


def test_noise_is_the_median_of_second_differences(scans):
    r, rays = scans[0].ranges_m, scans[0].rays
    cos = np.sum(rays[1:-1] * rays[2:], axis=1)
    bend = 1 / r[:-2] - 2 * cos / r[1:-1] + 1 / r[2:]
    bend /= np.sqrt(r[:-2] ** -4 + 4 * cos**2 * r[1:-1] ** -4 + r[2:] ** -4)
    together = scans[0].beams[2:] - scans[0].beams[:-2] == 2
    expected = np.median(np.abs(bend[together])) / 0.6745
    assert scans[0].noise_m == pytest.approx(expected, rel=0.02)  # of an even number, the upper


def test_a_line_grows_as_far_as_all_its_points_allow(scans):
    r, rays, noise = scans[0].ranges_m, scans[0].rays, scans[0].noise_m
    for first in range(0, len(r) - 1, 23):
        own, misses = [], []
        for i in range(first, len(r)):
            if i - (own[-1] if own else first) > 2:
                break
            if len(own) >= 2:
                A, v = r[own, None] ** 2 * rays[own], r[i] ** 2 * rays[i]
                spread = noise * math.sqrt(1.0 + v @ np.linalg.solve(A.T @ A, v))
                miss = (r[i] - v @ np.linalg.lstsq(A, r[own])[0]) / spread
                if abs(miss) > 3.5 or abs(sum(misses[-7:]) + miss) > 3.0 * math.sqrt(8.0):
                    continue
                misses.append(miss)
            own.append(i)
        line_of_point = np.full(len(r), -1)
        last, count, *m, _ = scan_lines._grown(r, rays, noise, first, 5, line_of_point, False)
        assert (last, count) == (own[-1], len(own))
        assert np.array_equal(np.flatnonzero(line_of_point == 5), own)
        A = r[own, None] ** 2 * rays[own]
        np.testing.assert_allclose(m, np.linalg.lstsq(A, r[own])[0], rtol=1e-6, atol=1e-9)


def test_neighbours_are_cut_where_both_fit_best(scans):
    r, rays, noise = scans[0].ranges_m, scans[0].rays, scans[0].noise_m
    line_of_point, lines, ends = scan_lines._grow(r, rays, noise, False)
    before = ends.copy()
    scan_lines._recut(r, rays, noise, line_of_point, lines, ends)
    moved = 0
    for k in range(len(lines) - 1):
        low, high = before[k, 1], before[k + 1, 0]
        span = np.arange(max(low - 12, ends[k, 0] + 1), min(high + 6, before[k + 1, 1] - 1))
        if high - low > 3 or len(span) == 0:
            continue
        miss = r[span] ** 2 * (1 / r[span] - lines[k : k + 2] @ rays[span].T)
        one, two = np.minimum(miss**2, (4 * noise) ** 2)
        costs = [one[:n].sum() + two[n:].sum() for n in range(len(span) + 1)]
        cut = ends[k, 1] - span[0] + 1
        assert costs[cut] == pytest.approx(min(costs), abs=1e-12)
        moved += ends[k, 1] != low
        on = np.where(np.arange(len(span)) < cut, k, k + 1)
        near = np.abs(np.where(on == k, *miss)) <= 4 * noise
        np.testing.assert_array_equal(line_of_point[span[near]], on[near])
    assert moved > 0


def test_fit_is_a_least_squares_step_in_the_ranges(scans):
    scan = scans[0]
    for k, line in enumerate(scan.lines):
        own = np.flatnonzero(scan.line_of_point == k)
        inverse = scan.rays[own] @ line
        J = -scan.rays[own] / inverse[:, None] ** 2
        step = np.linalg.lstsq(J, scan.ranges_m[own] - 1 / inverse)[0]
        m1, m2, *information = scan_lines._fit(scan.ranges_m, scan.rays, own, line)
        np.testing.assert_allclose([m1, m2], line + step, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(information, (J.T @ J)[[0, 0, 1], [0, 1, 1]], rtol=1e-9)


def test_a_wall_in_two_pieces_is_merged_by_their_information():
    bearings = np.linspace(-0.6, 0.6, 121)
    rays = np.column_stack([np.cos(bearings), np.sin(bearings)])
    ranges = 2.0 / rays[:, 0] + 0.01 * np.random.default_rng(3).standard_normal(121)
    of_point = np.repeat([0, 1], [60, 61])
    halves, forms = [], []
    for k in range(2):
        fit = scan_lines._fit(ranges, rays, np.flatnonzero(of_point == k), np.array([0.5, 0.0]))
        halves.append(fit[:2])
        forms.append(np.array([[fit[2], fit[3]], [fit[3], fit[4]]]))
    expected = np.linalg.solve(sum(forms), sum(S @ m for S, m in zip(forms, halves, strict=True)))
    ends, grown = np.array([[0, 59], [60, 120]]), np.tile([0.5, 0.0], (2, 1))
    lines, information, ends = scan_lines._merge(
        ranges, rays, np.arange(121), 0.01, of_point, grown, ends
    )
    np.testing.assert_allclose(lines, [expected], rtol=1e-9)
    np.testing.assert_allclose(information, [sum(forms)[[0, 0, 1], [0, 1, 1]]])
    assert ends.tolist() == [[0, 120]]
    assert not of_point.any()


def test_segments_end_at_the_next_beams(scans):
    scan = scans[0]
    normals, distances, spans, end_rays, variances, bends = scan.segments
    assert not bends.any()
    np.testing.assert_allclose(distances[:, None] * scan.lines, normals, atol=1e-12)
    along = np.column_stack([-normals[:, 1], normals[:, 0]])
    step = BEARINGS_RAD[1] - BEARINGS_RAD[0]
    for side, way in ((0, -1), (1, 1)):
        rays = turned(way * step, scan.rays[scan.line_ends[:, side]])
        np.testing.assert_allclose(end_rays[:, side], rays, atol=1e-12)
        ends = rays / np.sum(rays * scan.lines, axis=1)[:, None]
        short = np.abs(spans[:, side]) < 20.0  # farther ends are bounded
        np.testing.assert_allclose(spans[short, side], np.sum(ends * along, axis=1)[short])
    S = scan.line_information[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    across = np.einsum("ki,kij,kj->k", along, np.linalg.inv(S), along)
    assert np.all(variances >= scan.noise_m**2 * across * distances**2 * (1.0 - 1e-9))


def test_heading_is_the_peak_of_the_votes(scans):
    guess, window, bins = 0.05, 0.5, 180
    (source, target), votes = scans, np.zeros(181)
    angles = [np.arctan2(s.segments.normals[:, 1], s.segments.normals[:, 0]) for s in scans]
    counts = [np.diff(s.line_ends, axis=1)[:, 0] + 1 for s in scans]
    lengths = [np.diff(s.segments.spans_m, axis=1)[:, 0] for s in scans]
    turn = se2.wrap(angles[1] - angles[0][:, None] - guess)
    weight = np.minimum.outer(*counts) * np.minimum.outer(*lengths) / np.maximum.outer(*lengths)
    place = (turn / window + 1.0) * bins / 2.0
    inside = (place >= 0.0) & (place < bins)
    np.add.at(votes, place[inside].astype(int), (weight * (1.0 - place % 1.0))[inside])
    np.add.at(votes, place[inside].astype(int) + 1, (weight * (place % 1.0))[inside])
    best = 2 + np.argmax(np.convolve(votes, [0.3, 0.7, 1.0, 0.7, 0.3], "valid")[: bins - 3])
    near = np.arange(best - 2, best + 3)
    expected = guess + (votes[near] @ near / votes[near].sum() * 2.0 / bins - 1.0) * window
    assert icp_start.heading_by_lines(source, target, guess, window) == pytest.approx(expected)


def test_representatives_stand_for_the_root_of_a_lines_points(scans):
    scan = scans[0]
    points, counts = icp_start.representatives(scan)
    of_line = scan.line_of_point[points]
    for k, (first, last) in enumerate(scan.line_ends):
        own = points[of_line == k]
        assert len(own) <= min(icp_start._COARSE_POINTS, last - first + 1)
        assert np.all((own >= first) & (own <= last))
        np.testing.assert_allclose(
            counts[of_line == k], math.sqrt(last - first + 1) / min(6, last - first + 1)
        )


@TO_LINES
@pytest.mark.parametrize("coarse", [True, False])
def test_normal_equations_and_their_step(scans, to_lines, coarse):
    pair = pair_of(scans, to_lines)
    fit, misses, every = fit_at(pair)
    stage = icp_iterations.Stage(coarse, False, 0.2, 0.1 if coarse else 6.0, math.inf, 1.0)
    normal, gradient = icp_iterations._linearise(pair, stage, every, POSE, fit, misses)
    kept = misses <= 0.2**2
    assert np.array_equal(np.isnan(fit.residuals), ~kept)
    q = turned(POSE[2], pair.source.points[kept])
    if to_lines:
        n, d, *_ = (a[fit.matches[kept]] for a in pair.target.segments)
        J, e = [jacobian(n, q)], [np.sum(n * (q + POSE[:2]), axis=1) - d]
        facing = np.sum(n * turned(POSE[2], pair.source.rays[kept]), axis=1)
        variance = pair.noise_m**2 * (facing**2 + icp_iterations._GRAZING)
    else:
        off = q + POSE[:2] - pair.target.points[fit.matches[kept]]
        J, e = [jacobian(np.tile(axis, (len(q), 1)), q) for axis in np.eye(2)], list(off.T)
        variance = np.full(len(q), 2.0 * pair.noise_m**2)
    squared = sum(part**2 for part in e)
    np.testing.assert_allclose(fit.residuals[kept] ** 2, squared, atol=1e-12)
    if coarse:
        w = every.counts[kept] / (1.0 + squared / 0.1**2) ** 2
    else:
        w = every.counts[kept] * np.maximum(1.0 - squared / (36.0 * variance), 0.0) ** 2 / variance
    np.testing.assert_allclose(fit.weights[kept], w, rtol=1e-6, atol=1e-9 * w.max())
    A = sum(part.T @ (part * w[:, None]) for part in J)
    b = sum(part.T @ (w * error) for part, error in zip(J, e, strict=True))
    np.testing.assert_allclose(full(normal), A, rtol=1e-6, atol=1e-9 * A.max())
    np.testing.assert_allclose(gradient, b, rtol=1e-6, atol=1e-9 * np.abs(A).max())
    pose = POSE.copy()
    moved, turn, gained = icp_iterations._step(normal, gradient, pose)
    step = -np.linalg.solve(full(normal), gradient)
    np.testing.assert_allclose(pose - POSE, step, rtol=1e-3, atol=1e-5)  # it is slightly damped
    assert (moved, turn) == pytest.approx((np.hypot(*step[:2]), abs(step[2])), rel=1e-3, abs=1e-5)
    assert gained == pytest.approx(-gradient @ step, rel=1e-3)


@TO_LINES
def test_information_is_that_of_the_lines(scans, to_lines):
    pair = pair_of(scans, to_lines)
    fit, misses, every = fit_at(pair)
    stage = icp_iterations.Stage(False, False, 0.1, 6.0, math.inf, 1.0)
    metric, _ = icp_iterations._linearise(pair, stage, every, POSE, fit, misses)
    normal, information, spurious = icp_judgement.judge(pair, POSE, fit)
    np.testing.assert_allclose(normal, metric, rtol=1e-12, atol=1e-12 * metric.max())
    assert np.array_equal(fit.matches < 0, np.isnan(fit.residuals))
    kept = fit.weights > 0.0
    lines = fit.matches[kept] if to_lines else pair.target.line_of_point[fit.matches[kept]]
    q = turned(POSE[2], pair.source.points[kept])
    facing = np.sum(
        pair.target.segments.normals[lines] * turned(POSE[2], pair.source.rays[kept]), axis=1
    )
    w = (
        fit.weights[kept]
        if to_lines
        else 1 / (pair.noise_m**2 * (facing**2 + icp_iterations._GRAZING))
    )
    held = (lines >= 0) & (np.bincount(lines[lines >= 0], minlength=9999)[lines] >= 3)
    n, variance = (pair.target.segments[k][lines[held]] for k in (0, 4))
    for found, normals, weight in (
        (information, n, w[held]),
        (spurious, np.column_stack([-n[:, 1], n[:, 0]]), w[held] * variance),
    ):
        J = jacobian(normals, q[held])
        expected = J.T @ (J * weight[:, None])
        np.testing.assert_allclose(full(found), expected, rtol=1e-6, atol=1e-9 * expected.max())


@pytest.mark.parametrize("full_circle", [False, True])
def test_points_agree_are_denied_or_cannot_be_judged(full_circle):
    bearings = np.linspace(-np.pi, np.pi, 720, endpoint=False) if full_circle else BEARINGS_RAD
    rng = np.random.default_rng(4)
    scans = []
    for offset in (0.0, 0.4):
        ranges = 3.0 / np.maximum(np.abs(np.cos(bearings)), np.abs(np.sin(bearings))) + offset
        scans.append(prepare(ranges + 0.01 * rng.standard_normal(len(bearings)), bearings))
    scan, other = scans
    tolerance, agreed, denied = 0.05, np.zeros((3, 3)), np.zeros((3, 3))
    pose, lever = np.array([0.3, 0.2, 0.1]), (0.1, -0.2)
    icp_judgement.count_agreement(scan, other, pose, 0.3, lever, tolerance, agreed, denied)
    expected = [np.zeros((3, 3)), np.zeros((3, 3))]  # denied, agreed
    for point, line in zip(scan.points, scan.line_of_point, strict=True):
        at = se2.transform(pose, point[None])[0]
        side = other.rays[:, 0] * at[1] - other.rays[:, 1] * at[0]
        ahead = (side >= 0.0) & (np.roll(side, -1) < 0.0) & (other.rays @ at > 0.0)
        ahead[-1] &= full_circle
        if line < 0 or not ahead.any():
            continue
        beams = (np.argmax(ahead) + np.arange(2)) % len(side)
        on = other.line_of_point[beams]
        off = other.segments.normals[on] @ at - other.segments.distances_m[on]
        near = bool(np.any((on >= 0) & (np.abs(off) < tolerance)))
        if near or np.hypot(*at) <= other.ranges_m[beams].min() - 2.0 * tolerance:
            normal = turned(0.3, scan.segments.normals[line][None])
            J = jacobian(normal, turned(0.3, (point - lever)[None]))
            expected[near] += J.T @ J
    np.testing.assert_allclose(full(denied), expected[0], atol=1e-9)
    np.testing.assert_allclose(full(agreed), expected[1], atol=1e-9)
    assert min(np.trace(denied), np.trace(agreed)) > 10.0


@pytest.mark.parametrize("through_centroid", [False, True])
def test_planes_have_the_normals_of_the_nearest_neighbours(scans, through_centroid):
    points = scans[0].points
    planes = icp_start.planes_of(points, 6, through_centroid=through_centroid)
    near = KDTree(points).query(points, k=6)[1]
    share = 0
    for row, own in enumerate(near):
        normal = np.linalg.svd(points[own] - points[own].mean(axis=0))[2][1]
        if abs(normal @ planes.normals[row]) > 1.0 - 1e-9:
            share += 1
            members = own if through_centroid else [row]
            assert sorted(planes.members[row]) == sorted(members)
            at = points[members].mean(axis=0)
            assert planes.distances_m[row] == pytest.approx(planes.normals[row] @ at)
    assert share > 0.9 * len(points)  # at jumps of range neighbours may lie beyond the beams beside


def test_a_scan_of_fewer_points_than_neighbours_has_planes():
    points = np.array([[1.0, 0.0], [1.0, 0.1], [1.0, 0.2]])
    for through_centroid in (False, True):
        planes = icp_start.planes_of(points, 6, through_centroid=through_centroid)
        np.testing.assert_allclose(np.abs(planes.normals), [[1.0, 0.0]] * 3, atol=1e-12)
        np.testing.assert_allclose(np.abs(planes.distances_m), 1.0)


def test_trimming_leaves_out_the_farthest():
    misses = np.array([0.3, np.inf, 0.1, 0.4, 0.2])
    icp_iterations._trim(misses, 0.25)
    np.testing.assert_array_equal(misses, [0.3, np.inf, 0.1, np.inf, 0.2])
    icp_iterations._trim(misses, 0.999)
    np.testing.assert_array_equal(misses, [np.inf, np.inf, 0.1, np.inf, np.inf])


@pytest.mark.parametrize(("huber", "expected"), [(False, [0.25, 0.0]), (True, [1.0, 0.5])])
def test_kernels_weigh_by_standard_deviations(huber, expected):
    stage = icp_iterations.Stage(False, huber, 1.0, 2.0, math.inf, 1.0)
    found = [
        icp_iterations._weight(stage, size**2 * 2.0**2 * 0.01, 0.01) for size in (0.5**0.5, 2.0)
    ]
    assert found == pytest.approx(expected)
