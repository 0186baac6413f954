"""How a scan is put together from its kernels, and points are matched, against plain NumPy."""

import math

import numpy as np
import pytest

from estimators.laser import icp_iterations, icp_start, scan_lines
from estimators.laser.icp import prepare
from experiments.bench.icp import BEARINGS_RAD, pair
from sim import se2

POSE = np.array([0.04, -0.03, 0.02])


@pytest.fixture(params=["room", "corridor"], scope="module")
def made(request):
    return pair(request.param, "small", 3)


@pytest.fixture(scope="module")
def scans(made):
    return prepare(made.source_m, BEARINGS_RAD), prepare(made.target_m, BEARINGS_RAD)


def test_a_scan_keeps_the_beams_that_saw_something():
    rng = np.random.default_rng(0)
    bearings, ranges = np.linspace(-2.0, 2.0, 300), rng.uniform(0.5, 6.0, 300)
    ranges[rng.integers(0, 300, 60)] = rng.choice([0.0, -1.0, 5.0, np.nan, np.inf], 60)
    scan = prepare(ranges, bearings, 5.0)
    beams = np.flatnonzero(np.isfinite(ranges) & (ranges > 0.0) & (ranges < 5.0))
    np.testing.assert_array_equal(scan.beams, beams)
    np.testing.assert_array_equal(scan.ranges_m, ranges[beams])
    rays = np.column_stack([np.cos(bearings), np.sin(bearings)])[beams]
    np.testing.assert_allclose(scan.rays, rays, atol=1e-15)
    np.testing.assert_allclose(scan.points, ranges[beams, None] * rays, atol=1e-15)


def test_lines_grow_one_after_another(scans):
    r, rays, noise = scans[0].ranges_m, scans[0].rays, scans[0].noise_m
    expected, lines, ends, first = np.full(len(r), -1), [], [], 0
    while first < len(r):
        trial = np.full(len(r), -1)
        last, count, *line, determinant = scan_lines._grown(r, rays, noise, first, 0, trial, False)
        if count >= 3 and determinant > 0.0:
            expected[trial == 0] = len(lines)
            lines.append(line)
            ends.append([first, last])
            first = last
        first += 1
    found = scan_lines._grow(r, rays, noise, False)
    for one, other in zip(found, (expected, lines, ends), strict=True):
        np.testing.assert_array_equal(one, other)


def test_neighbours_are_merged_if_one_line_fits_both(scans):
    r, rays, noise = scans[0].ranges_m, scans[0].rays, scans[0].noise_m
    of_point, lines, ends = scan_lines._grow(r, rays, noise, False)
    scan_lines._recut(r, rays, noise, of_point, lines, ends)
    walls = []  # own points, m, information
    for k, (first, last) in enumerate(ends):
        own = first + np.flatnonzero(of_point[first : last + 1] == k)
        if len(own) < 3:
            continue
        a, b, *c = scan_lines._fit(r, rays, own, lines[k])
        m, S = np.array([a, b]), np.array([c[:2], c[1:]])
        if walls and scans[0].beams[own[0]] - scans[0].beams[walls[-1][0][-1]] <= 3:
            before, n, T = walls[-1]
            both = np.linalg.solve(S + T, S @ m + T @ n)
            misfit = (m - both) @ S @ (m - both) + (n - both) @ T @ (n - both)
            if misfit < 13.8 * noise**2:
                walls[-1] = (np.concatenate([before, own]), both, S + T)
                continue
        walls.append((own, m, S))
    merged = scan_lines._merge(r, rays, scans[0].beams, noise, of_point, lines, ends)
    assert len(walls) == len(merged[0]) < len(lines)
    for k, (own, m, S) in enumerate(walls):
        np.testing.assert_array_equal(np.flatnonzero(of_point == k), own)
        assert merged[2][k].tolist() == [own[0], own[-1]]
        np.testing.assert_allclose(merged[0][k], m, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(merged[1][k], S[[0, 0, 1], [0, 1, 1]], rtol=1e-9)


def test_direction_variances_grow_at_joints_of_a_curve():
    bearings = np.linspace(-1.0, 1.0, 201)
    curve = 2.0 * np.cos(bearings) + np.sqrt(9.0 - 4.0 * np.sin(bearings) ** 2)  # about (2, 0)
    scan = prepare(curve + 0.005 * np.random.default_rng(1).standard_normal(201), bearings)
    normals, distances, *_, variances, _ = scan.segments
    along = np.column_stack([-normals[:, 1], normals[:, 0]])
    S = scan.line_information[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    across = np.einsum("ki,kij,kj->k", along, np.linalg.inv(S), along)
    expected = scan.noise_m**2 * across * distances**2
    angles = np.abs(np.diff(np.unwrap(np.arctan2(normals[:, 1], normals[:, 0]))))
    gaps = scan.beams[scan.line_ends[1:, 0]] - scan.beams[scan.line_ends[:-1, 1]]
    joint = np.where((gaps <= 3) & (angles < 0.45), angles**2 / 12.0, 0.0)
    assert np.count_nonzero(joint) >= 3
    expected[1:] += joint
    expected[:-1] += joint
    np.testing.assert_allclose(variances, expected, rtol=1e-6)


def test_representatives_are_spaced_by_beams_and_by_length(scans):
    scan, expected = scans[0], []
    along = np.column_stack([-scan.segments.normals[:, 1], scan.segments.normals[:, 0]])
    for k, (first, last) in enumerate(scan.line_ends):
        own = np.arange(first, last + 1)
        here = min(icp_start._COARSE_POINTS, len(own))
        run = scan.points[own] @ along[k]
        wanted = run[0] + (run[-1] - run[0]) * np.arange(here) / (here - 1)
        run[-1] = math.inf  # the last one, if rounding leaves none
        by_length = own[np.argmax(run >= wanted[:, None], axis=1)]
        by_beams = first + (last - first) * np.arange(here) // (here - 1)
        odd = (np.arange(here) % 2 == 1) & (here == icp_start._COARSE_POINTS)
        chosen = np.where(odd, by_length, by_beams)
        expected += [i for i in chosen if scan.line_of_point[i] == k]
    np.testing.assert_array_equal(icp_start.representatives(scan).points, expected)


@pytest.mark.parametrize("to_lines", [True, False])
@pytest.mark.parametrize("reach_m", [math.inf, 3.0])
@pytest.mark.parametrize("warm", [True, False])
def test_points_are_matched_with_the_nearest(scans, to_lines, reach_m, warm):
    source, target = scans
    surface = target.segments if to_lines else icp_start.as_segments(target)
    both = icp_iterations.Pair(source, target, to_lines, to_lines, surface, surface, source.noise_m)
    n = len(source.points)
    every = icp_iterations.Sample(np.arange(n), np.ones(n))
    fit, misses = icp_iterations.Fit(np.zeros(n, np.int64), np.zeros(n), np.zeros(n)), np.empty(n)
    if warm:  # from the matches at another pose
        icp_iterations._match(both, reach_m, every, np.zeros(3), True, fit, misses)
    icp_iterations._match(both, reach_m, every, POSE, not warm, fit, misses)
    at = se2.transform(POSE, source.points)
    if to_lines:
        normals, distances, spans, *_ = surface
        across = at @ normals.T - distances
        along = at @ np.column_stack([-normals[:, 1], normals[:, 0]]).T
        beyond = np.maximum(spans[:, 0] - along, 0.0) + np.maximum(along - spans[:, 1], 0.0)
        squared = across**2 + beyond**2
    else:
        squared = np.sum((at[:, None] - target.points) ** 2, axis=2)
    reached = np.hypot(*source.points.T) <= reach_m
    assert np.all(np.isinf(misses[~reached]))
    nearest = squared.min(axis=1)[reached]
    best = np.abs(misses[reached] - nearest) <= 1e-9 + 1e-6 * nearest
    # the walk looks at neighbours by bearing, and may stop before a far match; never a near one
    assert np.all(best[nearest < 0.3**2])
    assert best.mean() > 0.95
