"""Registration against the true worlds, brute force, and its own definition."""

import math

import numpy as np
import pytest
from scipy.spatial import KDTree

from estimators.laser import icp, icp_iterations, icp_start
from estimators.laser.icp import Rules, better_by, prepare, register
from experiments.bench.icp import BEARINGS_RAD, SIGMA_RANGE_M, pair
from experiments.evaluation.scan_bound import cast, fisher_bound, fisher_information
from sim import se2
from sim.errors import InputError
from sim.sensors import Laser, Mount
from sim.sensors.casting import SegmentCaster
from sim.worlds.world import World

FULL_RAD = np.linspace(-np.pi, np.pi, 720, endpoint=False)
NO_SCAN = np.full(721, np.inf)


def ring(points):
    corners = np.array(points, float)
    return np.hstack([corners, np.roll(corners, -1, axis=0)])


def circle(radius_m):
    angle = np.linspace(0.0, 2.0 * np.pi, 720, endpoint=False)
    return ring(radius_m * np.column_stack([np.cos(angle), np.sin(angle)]))


ROOM = np.vstack(
    [
        ring([(-3, -2), (5, -2), (5, 4), (-3, 4)]),
        ring([(2, -1), (3, -0.6), (2.6, 0.4), (1.6, 0.0)]),
        ring([(-1.0, 2.5), (0.2, 2.5), (0.2, 3.1), (-1.0, 3.1)]),
    ]
)
BARE = np.array([[-200.0, -1.0, 200.0, -1.0], [-200.0, 1.0, 200.0, 1.0]])


def scan(walls, pose, rng=None, bearings=BEARINGS_RAD, max_range_m=80.0):
    ranges = cast(walls, np.asarray(pose, float), bearings)[0]
    if rng is not None:
        ranges = ranges + SIGMA_RANGE_M * rng.standard_normal(len(bearings))
    return prepare(ranges, bearings, max_range_m)


def difference(found, true):
    off = found - true
    off[2] = se2.wrap(off[2])
    return off


def test_bound_casts_as_the_simulator_does():
    world = World("room", ROOM, np.tile([0.0, 2.0], (len(ROOM), 1)))
    laser = Laser(mount=Mount(z_m=1.0))
    caster = SegmentCaster(world, laser)
    for pose in ([0.3, 0.4, 0.7], [-2.0, 3.0, -2.5]):
        expected = caster.cast(np.array(pose))
        found = cast(ROOM, np.array(pose), laser.bearings_rad)[0]
        assert np.mean(np.abs(found - expected) < 1e-6) > 0.99  # corners may fall to either side


def test_fisher_information_is_that_of_the_caster():
    pose, step = np.array([0.3, 0.4, 0.7]), 1e-6
    slope = np.empty((len(BEARINGS_RAD), 3))
    for k in range(3):
        offset = step * np.eye(3)[k]
        ahead, behind = (cast(ROOM, pose + o, BEARINGS_RAD)[0] for o in (offset, -offset))
        slope[:, k] = (ahead - behind) / (2.0 * step)
    slope = slope[np.abs(slope).max(axis=1) < 1e3]  # beams that a step moves across a corner
    expected = slope.T @ slope / SIGMA_RANGE_M**2
    found = fisher_information(ROOM, pose, BEARINGS_RAD, SIGMA_RANGE_M)
    np.testing.assert_allclose(found, expected, rtol=2e-2)


def test_lines_lie_on_the_walls(rng):
    pose = np.array([0.3, 0.4, 0.7])
    ranges, normals = cast(ROOM, pose, BEARINGS_RAD)
    found = scan(ROOM, pose, rng)
    assert found.noise_m == pytest.approx(SIGMA_RANGE_M, rel=0.15)
    on = found.line_of_point >= 0
    assert np.mean(on) > 0.97
    rays = found.rays[on]
    lines = found.lines[found.line_of_point[on]]
    fitted = 1.0 / np.sum(lines * rays, axis=1)
    off = np.abs(fitted - ranges[found.beams[on]])
    assert np.mean(off < SIGMA_RANGE_M) > 0.9  # far below the noise, thanks to the fit
    in_world = se2.transform(np.array([0.0, 0.0, pose[2]]), lines)
    in_world /= np.linalg.norm(in_world, axis=1)[:, None]
    along = np.abs(np.sum(in_world * normals[found.beams[on]], axis=1))
    assert np.mean(along > math.cos(math.radians(3.0))) > 0.95


def test_no_line_bridges_a_jump_or_a_corner():
    ranges, normals = cast(ROOM, np.array([0.3, 0.4, 0.7]), BEARINGS_RAD)
    found = prepare(ranges, BEARINGS_RAD)
    for line in range(len(found.lines)):
        own = normals[found.beams[found.line_of_point == line]]
        same = np.abs(own @ own[len(own) // 2]) > 0.999
        assert np.sum(~same) <= 1  # the beam next to a corner is within the noise of both walls


def test_beams_that_saw_nothing_are_left_out():
    ranges = cast(ROOM, np.zeros(3), BEARINGS_RAD)[0]
    ranges[::7], ranges[1::7], ranges[2::7], ranges[3::7] = np.nan, np.inf, 0.0, -1.0
    found = prepare(ranges, BEARINGS_RAD, max_range_m=3.0)
    assert set(found.beams % 7) <= {4, 5, 6}
    assert found.ranges_m.max() <= 3.0


def test_the_walk_finds_the_nearest(rng):
    for bearings, full in ((BEARINGS_RAD, False), (FULL_RAD, True)):
        target = scan(ROOM, [0.3, 0.4, 0.7], rng, bearings)
        assert target.full_circle == full
        as_segments = icp_start.as_segments(target)
        tree = KDTree(target.points)
        for _ in range(300):
            # before the sensor: what is behind a half-circle of beams is beyond the walk
            x, y = rng.uniform(-4.0 if full else 0.05, 4.0), rng.uniform(-4.0, 4.0)
            start = int(rng.integers(len(target.points)))
            near, squared = icp_iterations.nearest(as_segments, full, start, x, y)
            assert squared == pytest.approx(tree.query([x, y])[0] ** 2)
            assert squared == pytest.approx(np.sum((target.points[near] - (x, y)) ** 2))
            normals, distances, spans, *_ = target.segments
            along = normals[:, 0] * y - normals[:, 1] * x
            over = np.maximum(spans[:, 0] - along, along - spans[:, 1])
            squares = (normals @ (x, y) - distances) ** 2 + np.maximum(over, 0.0) ** 2
            start = int(rng.integers(len(target.lines)))
            near, squared = icp_iterations.nearest(target.segments, full, start, x, y)
            assert squared == pytest.approx(squares.min())
            assert squared == pytest.approx(squares[near])


@pytest.mark.parametrize("motion", [[0.05, -0.02, 0.03], [0.18, 0.1, -0.14], [-0.1, 0.2, 0.14]])
def test_exact_without_noise(motion):
    target, source = scan(ROOM, [0.3, 0.4, 0.7]), scan(ROOM, se2.compose([0.3, 0.4, 0.7], motion))
    found = register(source, target)
    assert found.status == "ok"
    assert found.converged
    # a beam beside a corner may go to the wrong wall of the two
    np.testing.assert_allclose(difference(found.T_target_source, motion), 0.0, atol=2e-4)
    found = register(source, target, metric="point_to_point")
    np.testing.assert_allclose(difference(found.T_target_source, motion), 0.0, atol=4e-3)


@pytest.mark.parametrize("place", ["room", "corridor"])
@pytest.mark.parametrize("size", ["small", "large"])
def test_near_the_bound_and_never_lost(place, size):
    squares = []
    for seed in range(25):
        p = pair(place, size, seed)
        found = register(prepare(p.source_m, BEARINGS_RAD), prepare(p.target_m, BEARINGS_RAD))
        off = difference(found.T_target_source, p.T_target_source)
        assert found.status == "ok"
        assert np.hypot(off[0], off[1]) < 0.03
        assert abs(off[2]) < math.radians(0.3)
        squares.append(off @ np.linalg.solve(p.bound, off))
    assert 0.7 < math.sqrt(np.median(squares) / 2.366) < 1.35


def test_the_bound_of_a_pair_is_the_sum_of_two(rng):
    """Localizing both scans in the known walls by the information reaches the bound."""
    target, motion = np.array([0.3, 0.4, 0.7]), np.array([0.2, 0.1, 0.1])
    poses = target, se2.compose(target, motion)
    bound = fisher_bound(ROOM, *poses, BEARINGS_RAD, SIGMA_RANGE_M)
    covariances = [
        np.linalg.inv(fisher_information(ROOM, p, BEARINGS_RAD, SIGMA_RANGE_M)) for p in poses
    ]
    drawn = [rng.multivariate_normal(p, c, 4000) for p, c in zip(poses, covariances, strict=True)]
    sampled = np.cov(se2.between(drawn[0], drawn[1]).T)
    np.testing.assert_allclose(np.linalg.solve(bound, sampled), np.eye(3), atol=0.15)


def test_a_turned_sensor_sees_the_same_motion_turned(rng):
    yaw = 0.4
    p = pair("room", "large", 3)
    plain = register(prepare(p.source_m, BEARINGS_RAD), prepare(p.target_m, BEARINGS_RAD))
    turned = register(
        prepare(p.source_m, BEARINGS_RAD + yaw), prepare(p.target_m, BEARINGS_RAD + yaw)
    )
    frame = np.array([0.0, 0.0, yaw])
    expected = se2.compose(se2.compose(frame, plain.T_target_source), se2.inverse(frame))
    np.testing.assert_allclose(turned.T_target_source, expected, atol=1e-7)
    np.testing.assert_allclose(turned.normal_matrix[2, 2], plain.normal_matrix[2, 2], rtol=1e-4)


@pytest.mark.parametrize("metric", ["point_to_line", "point_to_plane", "point_to_point"])
def test_result_is_a_minimum_with_its_normal_matrix(metric, rng, monkeypatch):
    target = scan(ROOM, [0.3, 0.4, 0.7], rng)
    source = scan(ROOM, [0.35, 0.42, 0.72], rng)
    for name in ("_REST_M", "_REST_RAD"):
        monkeypatch.setattr(icp, name, 1e-9)
    found = register(source, target, metric=metric)
    kept = found.inliers

    def residuals(pose):
        moved = se2.transform(pose, source.points[kept])
        if metric == "point_to_plane":
            normals, offsets = (a[found.matches[kept]] for a in found.planes[:2])
            return np.sum(normals * moved, axis=1) - offsets
        if metric == "point_to_line":
            m = target.lines[found.matches[kept]]
            return (np.sum(m * moved, axis=1) - 1.0) / np.linalg.norm(m, axis=1)
        return (moved - target.points[found.matches[kept]]).ravel()

    at = found.T_target_source
    e, step = residuals(at), 1e-6
    J = np.stack(
        [(residuals(at + o) - residuals(at - o)) / (2 * step) for o in step * np.eye(3)], axis=1
    )
    weights = np.repeat(found.weights[kept], len(e) // kept.sum())
    size = e if metric != "point_to_point" else np.hypot(*e.reshape(-1, 2).T)
    np.testing.assert_allclose(found.residuals_m[kept], size, atol=1e-5)
    np.testing.assert_allclose(J.T @ (weights[:, None] * J), found.normal_matrix, rtol=1e-6)
    step = np.linalg.solve(found.normal_matrix, J.T @ (weights * e))
    assert step @ found.normal_matrix @ step < 1e-4  # a hundredth of a standard deviation


@pytest.mark.parametrize("off", [[0.03, 0.02, 0.02], [-0.05, 0.03, -0.03]])
def test_long_walls_do_not_trap_a_wrong_heading(off, rng):
    """At 40 m an error of 0.03 rad takes the points of one wall to the other."""
    for _ in range(10):
        motion = np.array([0.05, 0.0, rng.normal(0.0, 0.02)])
        start = np.array([0.0, rng.uniform(-0.4, 0.4), 0.03])
        target, source = scan(BARE, start, rng), scan(BARE, se2.compose(start, motion), rng)
        found = register(source, target, motion + off, gate_m=0.6)
        assert found.T_target_source[2] == pytest.approx(motion[2], abs=1e-3)
        assert found.iterations < 40  # and the free direction does not keep it going


def test_weights_are_of_the_noise_along_the_beam(rng):
    target, source = scan(ROOM, [0.3, 0.4, 0.7], rng), scan(ROOM, [0.35, 0.42, 0.72], rng)
    found = register(source, target)
    kept = found.inliers
    normals = target.segments.normals[found.matches[kept]]
    turned = se2.transform([0.0, 0.0, found.T_target_source[2]], source.rays[kept])
    variance = max(source.noise_m, target.noise_m) ** 2 * np.sum(normals * turned, axis=1) ** 2
    facing = variance > 0.1 * variance.max()
    tukey = (1.0 - found.residuals_m[kept] ** 2 / (6.0**2 * variance)) ** 2
    ratio = (found.weights[kept] * variance / tukey)[facing]
    assert np.all((ratio > 0.97) & (ratio <= 1.0))


def test_noise_of_a_wall_feigns_information_along_it(rng):
    along = np.array([np.cos(2.2), np.sin(2.2)])
    off = np.array([3.0 * along[1], -3.0 * along[0]])
    wall = np.array([[*(off - 9.0 * along), *(off + 9.0 * along)]])
    found = register(scan(wall, np.zeros(3), rng), scan(wall, np.zeros(3), rng), np.zeros(3))
    assert found.status == "degenerate"
    assert np.abs(np.linalg.eigh(found.information_noise[:2, :2])[1][:, 1] @ along) > 0.999
    assert np.abs(np.linalg.eigh(found.information[:2, :2])[1][:, 1] @ along) < 0.05


def test_outliers_do_not_move_it(rng):
    target, source = (
        scan(ROOM, [0.3, 0.4, 0.7], rng),
        cast(ROOM, np.array([0.35, 0.42, 0.72]), BEARINGS_RAD)[0],
    )
    source += SIGMA_RANGE_M * rng.standard_normal(721)
    source[100:160] = 1.0 + 0.3 * rng.random(60)  # somebody walks by
    found = register(prepare(source, BEARINGS_RAD), target)
    true = se2.between(np.array([0.3, 0.4, 0.7]), np.array([0.35, 0.42, 0.72]))
    assert np.all(np.abs(difference(found.T_target_source, true)) < 0.005)
    assert found.overlap < 0.95


@pytest.mark.parametrize("metric", ["point_to_line", "point_to_point"])
def test_what_cannot_be_registered_says_so(metric, rng):
    room = scan(ROOM, [0.3, 0.4, 0.7], rng)
    for empty in (
        prepare(NO_SCAN, BEARINGS_RAD),
        prepare(np.full(721, np.nan), BEARINGS_RAD),
        prepare(np.full(721, 90.0), BEARINGS_RAD, 80.0),
        prepare([], []),
        prepare([1.0], [0.0]),
    ):
        for source, target in ((empty, room), (room, empty), (empty, empty)):
            found = register(source, target, [0.1, 0.2, 0.3], metric=metric)
            assert found.status == "empty"
            assert np.array_equal(found.T_target_source, [0.1, 0.2, 0.3])
    turned = scan(ROOM, [0.3, 0.4, 0.7 + np.pi], rng)
    assert register(turned, room, metric=metric).status != "ok"
    noise = [prepare(rng.uniform(0.5, 10.0, 721), BEARINGS_RAD) for _ in range(2)]
    assert register(*noise, metric=metric).status != "ok"
    few = NO_SCAN.copy()
    few[300:304] = 3.0
    for other in (room, prepare(few, BEARINGS_RAD)):
        assert register(prepare(few, BEARINGS_RAD), other, metric=metric).status != "ok"


@pytest.mark.parametrize("metric", ["point_to_line", "point_to_point"])
@pytest.mark.parametrize("bearings", [BEARINGS_RAD, FULL_RAD], ids=["half", "full"])
def test_directions_nobody_holds_are_degenerate(metric, bearings, rng):
    for radius in (2.0, 5.0, 10.0):
        found = register(
            scan(circle(radius), [0.05, 0.0, 0.1], rng, bearings),
            scan(circle(radius), [0.0, 0.0, 0.0], rng, bearings),
            metric=metric,
        )
        assert found.status == "degenerate"
    for motion in ([0.1, 0.0, 0.05], [0.02, 0.1, -0.1]):
        found = register(
            scan(BARE, motion, rng, bearings), scan(BARE, np.zeros(3), rng, bearings), metric=metric
        )
        assert found.status == "degenerate"
        # two walls say nothing along them, but all across them
        assert found.T_target_source[1:] == pytest.approx(motion[1:], abs=0.01)


def test_rules_choose_the_matches_and_the_end(rng):
    source, target = (scan(ROOM, at, rng) for at in ([0.35, 0.42, 0.72], [0.3, 0.4, 0.7]))
    usual = register(source, target)
    for rules in (Rules(trim=0.1), Rules(kernel="huber"), Rules(kernel="none")):
        found = register(source, target, rules=rules)
        assert not np.array_equal(found.weights, usual.weights)
        np.testing.assert_allclose(found.T_target_source, usual.T_target_source, atol=0.01)
    assert register(source, target, rules=Rules(trim=0.3)).overlap < 0.71
    soon = register(source, target, rules=Rules(stop_error_m=0.1))
    assert soon.iterations < usual.iterations
    assert np.sqrt(np.mean(soon.residuals_m[soon.inliers] ** 2)) < 0.1
    hurried = register(source, target, rules=Rules(max_iterations=1))
    assert (hurried.iterations, hurried.converged) == (4, False)


def test_identical_scans_do_not_move(rng):
    room = scan(ROOM, [0.3, 0.4, 0.7], rng)
    found = register(room, room)
    assert found.status == "ok"
    np.testing.assert_allclose(found.T_target_source, 0.0, atol=2e-4)


def test_the_heading_search_goes_about_the_guess(rng):
    target = scan(ROOM, [0.3, 0.4, 0.7], rng, FULL_RAD)
    source = scan(ROOM, [0.3, 0.4, 2.2], rng, FULL_RAD)
    found = register(source, target, [0.0, 0.0, 1.2], heading_window_rad=0.5)
    np.testing.assert_allclose(found.T_target_source, [0.0, 0.0, 1.5], atol=0.005)


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"metric": "plane"}, "point_to_line"),
        ({"initial": [0.0, np.nan, 0.0]}, "finite"),
    ],
)
def test_wrong_options_are_named(options, word):
    room = scan(ROOM, [0.3, 0.4, 0.7])
    with pytest.raises(InputError, match=word):
        register(room, room, **options)
    with pytest.raises(InputError, match="one bearing"):
        prepare(np.ones(3), np.zeros(2))
    with pytest.raises(InputError, match="rise"):
        prepare(np.ones(3), np.array([0.2, 0.1, 0.0]))


@pytest.fixture
def rng():
    return np.random.default_rng(11)


@pytest.mark.parametrize("seed", range(8))
def test_what_the_scans_do_not_hold_stays_as_guessed(seed):
    # in a round hall the turn about its centre is free; it used to wander by 0.2 rad
    rng = np.random.default_rng(seed)
    walls, start, motion = circle(8.0), np.array([3.0, 1.0, 0.4]), np.array([0.6, 0.05, 0.1])
    scans = [
        prepare(
            cast(walls, pose, BEARINGS_RAD)[0] + SIGMA_RANGE_M * rng.standard_normal(721),
            BEARINGS_RAD,
            curves=True,
        )
        for pose in (start, se2.compose(start, motion))
    ]
    found = register(scans[1], scans[0], motion, gate_m=0.5, gate_rad=0.1)
    assert found.status == "degenerate"
    off = difference(found.T_target_source, motion)
    assert abs(off[2]) < 1e-3
    assert np.hypot(*off[:2]) < 0.01


def test_points_bear_out_the_true_pose_and_nothing_along_a_corridor(rng):
    """By how many points tells a slip of the wheels from a match that wandered."""
    start, moved, off = np.zeros(3), np.array([0.3, 0.1, 0.05]), np.array([0.2, 0.0, 0.0])
    noise_m = SIGMA_RANGE_M
    room, again = scan(ROOM, start, rng), scan(ROOM, moved, rng)
    assert better_by(again, room, moved, moved + off, noise_m) > 30.0
    assert better_by(again, room, moved + off, moved, noise_m) < -30.0
    corridor, along = scan(BARE, start, rng), scan(BARE, np.array([0.3, 0.0, 0.0]), rng)
    for wrong in (off, -off):
        at = np.array([0.3, 0.0, 0.0])
        assert abs(better_by(along, corridor, at + wrong, at, noise_m)) < 1.0
