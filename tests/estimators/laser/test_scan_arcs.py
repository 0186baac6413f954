"""Curves and jump edges: arcs against the true curves, registrations beside those of lines."""

import math

import numpy as np
import pytest

from estimators.laser import icp_covariance
from estimators.laser.icp import prepare, register
from estimators.laser.icp_iterations import distance
from experiments.evaluation.scan_bound import cast
from sim import se2
from tests.estimators.laser.test_icp import BEARINGS_RAD, circle

SIGMA_M = 0.01
MOTION = np.array([0.45, 0.03, 0.1])


def pillars(radius_m=0.35):
    """Walls of a round hall with nine round pillars in it."""
    rng = np.random.default_rng(5)
    walls = [circle(9.0)]
    for k in range(9):
        angle = 0.7 * k + rng.uniform(0.0, 0.3)
        centre = rng.uniform(3.0, 6.5) * np.array([math.cos(angle), math.sin(angle)])
        walls.append(circle(radius_m) + np.tile(centre, 2))
    return np.concatenate(walls)


def legs():
    """Walls of a hall, hidden for the most part behind the legs of many tables."""
    rng = np.random.default_rng(3)
    box = np.array([[-9, -7, 9, -7], [9, -7, 9, 7], [9, 7, -9, 7], [-9, 7, -9, -7]], float)
    spots = rng.uniform((-8, -6), (8, 6), (260, 2))
    spots = spots[np.hypot(*spots.T) > 1.0]
    half = 0.02
    corners = half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
    squares = [np.hstack([spot + corners[:-1], spot + corners[1:]]) for spot in spots]
    return np.concatenate([box, *squares])


def pairs(walls, n=30, motion=MOTION):
    """Ranges of `n` pairs of scans from places near the middle."""
    for seed in range(n):
        rng = np.random.default_rng(seed)
        at = np.array([*rng.uniform(-0.6, 0.6, 2), rng.uniform(-math.pi, math.pi)])
        yield [
            cast(walls, pose, BEARINGS_RAD)[0] + SIGMA_M * rng.standard_normal(len(BEARINGS_RAD))
            for pose in (at, se2.compose(at, motion))
        ]


def errors(walls, *, curves):
    """Errors (K, 3) of registrations, and NEES over 3."""
    off, nees = [], []
    for target_m, source_m in pairs(walls):
        target, source = (prepare(r, BEARINGS_RAD, curves=curves) for r in (target_m, source_m))
        guess = MOTION + np.array([0.02, -0.02, 0.01])
        found = register(source, target, guess, gate_m=0.5, gate_rad=0.08)
        if found.status == "poor_overlap":
            continue
        R = icp_covariance.censi(found, source, target, SIGMA_M)
        d = se2.difference(found.T_target_source, MOTION)
        off.append(d)
        nees.append(d @ np.linalg.solve(R, d) / 3.0)
    return np.array(off), np.array(nees)


@pytest.mark.parametrize(("radius_m", "away_m"), [(1.6, 4.0), (10.0, 2.0), (0.5, 2.0)])
def test_arcs_lie_on_their_curve_where_chords_do_not(radius_m, away_m):
    facing = away_m * np.cos(BEARINGS_RAD)
    squared = radius_m**2 - (away_m * np.sin(BEARINGS_RAD)) ** 2
    with np.errstate(invalid="ignore"):
        root = np.sqrt(squared)
    true_m = facing + root if radius_m > away_m else facing - root
    noise = SIGMA_M * np.random.default_rng(0).standard_normal(len(true_m))
    ranges = np.where(np.isfinite(true_m) & (true_m > 0.0), true_m + noise, np.inf)
    rms, counts = [], []
    for curves in (False, True):
        scan = prepare(ranges, BEARINGS_RAD, curves=curves)
        off = [
            distance(scan.segments, line, *(true_m[scan.beams[i]] * scan.rays[i]))[0]
            for i, line in enumerate(scan.line_of_point)
            if line >= 0
        ]
        rms.append(np.sqrt(np.mean(np.square(off))))
        counts.append(len(scan.lines))
    assert rms[1] < 0.9 * rms[0]
    assert counts[1] < counts[0]
    bends = scan.segments.bends[:, 0]
    sign = -1.0 if radius_m > away_m else 1.0
    widest = np.argmax(np.diff(scan.line_ends, axis=1))
    assert bends[widest] == pytest.approx(sign * 0.5 / radius_m, rel=0.25)


def test_a_straight_wall_stays_straight():
    walls = np.array([[-5, -4, 6, -4], [6, -4, 6, 5], [6, 5, -5, 5], [-5, 5, -5, -4]], float)
    for target_m, _ in pairs(walls, n=10):
        one, other = (prepare(target_m, BEARINGS_RAD, curves=curves) for curves in (False, True))
        assert np.count_nonzero(other.segments.bends[:, 0]) <= 1
        assert len(other.lines) == pytest.approx(len(one.lines), abs=2)


def test_the_distance_from_an_arc_has_its_normal_for_a_gradient():
    target = prepare(next(pairs(pillars()))[0], BEARINGS_RAD, curves=True)
    bent = np.flatnonzero(target.segments.bends[:, 0])
    assert len(bent) >= 3
    for line in bent:
        x, y = target.points[target.line_ends[line].sum() // 2] * 1.01
        off, *normal = distance(target.segments, line, x, y)
        step = 1e-6
        slopes = [
            (
                distance(target.segments, line, x + step * u, y + step * v)[0]
                - distance(target.segments, line, x - step * u, y - step * v)[0]
            )
            / (2.0 * step)
            for u, v in ((1.0, 0.0), (0.0, 1.0))
        ]
        curvature = 2.0 * abs(target.segments.bends[line, 0])
        np.testing.assert_allclose(slopes, normal, atol=1e-6 + 2.0 * curvature * abs(off))


def test_derivatives_of_an_arc_by_its_line_and_bend():
    target = prepare(next(pairs(pillars()))[0], BEARINGS_RAD, curves=True)
    segments = target.segments
    line = int(np.flatnonzero(segments.bends[:, 0])[0])
    x, y = target.points[target.line_ends[line].sum() // 2] * 1.002
    *_, e1, e2, by_bend = icp_covariance._on_arc(segments, line, x, y)

    def off_with(m, bend):
        size = np.hypot(*m)
        normals, distances, bends = (
            part.copy() for part in (segments[0], segments[1], segments[5])
        )
        normals[line], distances[line], bends[line, 0] = m / size, 1.0 / size, bend
        changed = segments._replace(normals=normals, distances_m=distances, bends=bends)
        return distance(changed, line, x, y)[0]

    m, bend, step = target.lines[line], segments.bends[line, 0], 1e-6
    by_m = [
        (off_with(m + step * axis, bend) - off_with(m - step * axis, bend)) / (2.0 * step)
        for axis in np.eye(2)
    ]
    np.testing.assert_allclose(by_m, [e1, e2], rtol=0.02, atol=0.02 * np.hypot(e1, e2))
    slope = (off_with(m, bend + step) - off_with(m, bend - step)) / (2.0 * step)
    assert slope == pytest.approx(by_bend, rel=1e-3, abs=1e-6)


def test_a_curved_scan_against_itself_is_the_identity():
    for ranges, _ in pairs(pillars(), n=5):
        scan = prepare(ranges, BEARINGS_RAD, curves=True)
        found = register(scan, scan, [0.02, 0.01, 0.005], gate_m=0.5, gate_rad=0.05)
        assert np.all(np.abs(found.T_target_source) < [1e-3, 1e-3, 3e-4])


def test_noise_is_measured_away_from_the_edges_of_chair_legs():
    walls = legs()
    noises = {
        curves: [prepare(r, BEARINGS_RAD, curves=curves).noise_m for r, _ in pairs(walls, n=10)]
        for curves in (False, True)
    }
    assert np.median(noises[True]) < 1.6 * SIGMA_M
    assert np.median(noises[False]) > 1.5 * np.median(noises[True])


@pytest.mark.slow
@pytest.mark.parametrize("world", [pillars, legs])
def test_errors_are_believed_among_pillars_and_chair_legs(world):
    walls = world()
    off, nees = errors(walls, curves=True)
    _, nees_of_lines = errors(walls, curves=False)
    assert len(off) >= 28
    assert np.median(nees) < 2.5
    assert np.mean(nees) < np.mean(nees_of_lines)
    assert np.hypot(*off[:, :2].T).max() < 0.03
