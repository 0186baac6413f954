"""The exact caster against slow, independent geometry, and its invariances."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim.se2 import compose
from sim.sensors import Laser, Lidar3D, Mount
from sim.sensors.casting import SegmentCaster, cast_lidar, visible
from sim.worlds.world import World

Z = Mount().z_m


def world_of(walls, z=(0.0, 1.0)):
    walls = np.asarray(walls, float).reshape(-1, 4)
    heights = np.broadcast_to(np.asarray(z, float), (len(walls), 2)).copy()
    return World("test", walls, heights)


def chain(corners):
    corners = np.asarray(corners, float)
    return np.concatenate([corners[:-1], corners[1:]], axis=1)


def box(x, y, half_length, half_width, yaw):
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
    corners = corners * [half_length, half_width]
    rotation = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    return chain(corners @ rotation.T + [x, y])


def random_walls(rng, n_boxes=8, n_lone=6, side=10.0):
    """Boxes that overlap, turned either way round, lone walls, and an open polyline."""
    walls = [box(*rng.uniform(-side, side, 2), *rng.uniform(0.1, 2.0, 2), rng.uniform(-4, 4))]
    for _ in range(n_boxes - 1):
        sides = box(*rng.uniform(-side, side, 2), *rng.uniform(0.1, 2.0, 2), rng.uniform(-4, 4))
        walls.append(sides if rng.random() < 0.5 else sides[::-1][:, [2, 3, 0, 1]])
    starts = rng.uniform(-side, side, (n_lone, 2))
    walls.append(np.hstack([starts, starts + rng.normal(0.0, 3.0, (n_lone, 2))]))
    walls.append(chain(rng.uniform(-side, side, (4, 2))))
    walls.append(chain(np.append(star := rng.uniform(-side, side, (5, 2)), star[:1], axis=0)))
    return np.concatenate(walls)


def slow_ranges(walls, pose, bearings, max_range):
    """Solve start + r d = a + t (b - a) for every ray and wall."""
    ranges = np.full(len(bearings), np.inf)
    for j, angle in enumerate(bearings + pose[2]):
        d = np.array([math.cos(angle), math.sin(angle)])
        for wall in walls:
            a, along = wall[:2], wall[2:] - wall[:2]
            system = np.column_stack([d, -along])
            if np.linalg.det(system) == 0.0:
                continue
            r, t = np.linalg.solve(system, a - pose[:2])
            if r >= 0.0 and 0.0 <= t <= 1.0:
                ranges[j] = min(ranges[j], r)
    return np.where(ranges <= max_range, ranges, np.inf)


def clear_of_corners(walls, pose, bearings, margin=1e-8):
    """Beams that pass no corner, where one rounding decides between hit and miss."""
    corners = np.concatenate([walls[:, :2], walls[:, 2:]]) - pose[:2]
    directions = np.arctan2(corners[:, 1], corners[:, 0]) - pose[2]
    off = np.abs(np.angle(np.exp(1j * (bearings[:, None] - directions[None]))))
    return np.all(off > margin, axis=1)


def assert_equal_ranges(ranges, expected, tolerance=1e-9):
    np.testing.assert_array_equal(np.isinf(ranges), np.isinf(expected))
    seen = np.isfinite(expected)
    np.testing.assert_allclose(ranges[seen], expected[seen], rtol=0.0, atol=tolerance)


@pytest.mark.parametrize("fov_rad", [0.01, math.pi, 4.5, 2 * math.pi])
@pytest.mark.parametrize("n_beams", [1, 2, 5, 90])
def test_against_slow_geometry(fov_rad, n_beams):
    rng = np.random.default_rng([n_beams, int(fov_rad * 100)])
    for _ in range(3):
        walls = random_walls(rng)
        laser = Laser(n_beams=n_beams, fov_rad=fov_rad, max_range_m=12.0)
        poses = rng.uniform(-10, 10, (4, 3))
        poses[:, 2] *= 3.0
        caster = SegmentCaster(world_of(walls), laser)
        ranges = caster.cast_many(poses)
        for pose, got in zip(poses, ranges, strict=True):
            np.testing.assert_array_equal(caster.cast(pose), got)
            expected = slow_ranges(walls, pose, laser.bearings_rad, 12.0)
            clear = clear_of_corners(walls, pose, laser.bearings_rad)
            assert_equal_ranges(got[clear], expected[clear])


def test_only_faces_at_the_height_of_the_laser():
    walls = [[3, -1, 3, 1], [2, -1, 2, 1], [1, -1, 1, 1]]
    world = world_of(walls, [[0.0, 1.0], [Z + 0.1, 1.0], [0.0, Z - 0.1]])
    assert SegmentCaster(world, Laser(n_beams=1)).cast([0, 0, 0])[0] == pytest.approx(3.0)


def test_inside_a_box_seen_with_others():
    walls = np.concatenate([box(0, 0, 2, 2, 0), box(0.5, 0, 3, 4, 0), box(9, 0, 1, 1, 0)])
    laser = Laser(n_beams=4, fov_rad=2 * math.pi)
    caster = SegmentCaster(world_of(walls), laser)
    assert_equal_ranges(caster.cast([0, 0, 0]), np.full(4, 2.0))
    # inside the larger box only; outside both; the order of bearings is -pi, -pi/2, 0, pi/2
    assert_equal_ranges(caster.cast([3, 0, 0]), np.array([1.0, 4.0, 0.5, 4.0]))
    assert_equal_ranges(caster.cast([6, 0, 0]), np.array([2.5, np.inf, 2.0, np.inf]))


def test_ends_of_walls_are_exact_to_a_few_nanoradians():
    rng = np.random.default_rng(4)
    laser = Laser(n_beams=720, fov_rad=2 * math.pi)
    for gap in (3e-9, 3e-8, 3e-7, 3e-6):
        for j, heading in zip(rng.integers(2, 718, 150), rng.uniform(-4, 4, 150), strict=True):
            # from just after beam j - 1 or just before it, to just before or after beam j + 1
            late, long = rng.choice([-1, 1], 2)
            angles = laser.bearings_rad[[j - 1, j + 1]] + [late * gap, long * gap] + heading
            radius = rng.uniform(1.0, 9.0, 2)
            ends = radius[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
            ends = ends[:: rng.choice([-1, 1])]
            ranges = SegmentCaster(world_of([ends.ravel()]), laser).cast([0, 0, heading])
            seen = np.isfinite(ranges[j - 2 : j + 3])
            assert seen.tolist() == [False, late < 0, True, long > 0, False]
            assert np.isfinite(ranges).sum() == seen.sum()


def test_far_small_faces_seen_nearly_along_their_plane_stay_small():
    """Their ends have the same bearing up to rounding, which may put them in the wrong order."""
    rng = np.random.default_rng(9)
    laser = Laser(n_beams=91, fov_rad=2 * math.pi, max_range_m=1e6)
    for _ in range(1000):
        angle, tilt = rng.uniform(-4, 4), 10 ** rng.uniform(-9, -4)
        radius, length = 10 ** rng.uniform(3, 5), 10 ** rng.uniform(-5, -4)
        start = radius * np.array([np.cos(angle), np.sin(angle)])
        along = length * np.array([np.cos(angle + tilt), np.sin(angle + tilt)])
        wall = [*start, *(start + rng.choice([-1, 1]) * along)]
        ranges = SegmentCaster(world_of([wall]), laser).cast([*rng.normal(0, 1e-6, 2), 0.2])
        assert np.isinf(ranges).sum() >= 90


def test_max_range_and_empty_world():
    laser = Laser(n_beams=3, fov_rad=0.2, max_range_m=5.0)
    caster = SegmentCaster(world_of([[5, -9, 5, 9]]), laser)
    assert np.isfinite(caster.cast([1e-9, 0, 0])).tolist() == [False, True, False]
    assert np.all(np.isinf(caster.cast([-0.1, 0, 0])))
    assert np.all(np.isinf(SegmentCaster(world_of(np.zeros((0, 4))), laser).cast([0, 0, 0])))


def test_wall_across_the_seam_of_the_scan():
    for fov_rad, n_beams in ((2 * math.pi, 360), (6.2, 361), (2 * math.pi, 7)):
        laser = Laser(n_beams=n_beams, fov_rad=fov_rad)
        ranges = SegmentCaster(world_of([[-2, 3, -2, -4]]), laser).cast([0, 0, 0])
        with np.errstate(divide="ignore"):
            expected = -2.0 / np.cos(laser.bearings_rad)
        lateral = expected * np.sin(laser.bearings_rad)
        expected[(expected < 0) | (lateral > 3) | (lateral < -4)] = np.inf
        assert_equal_ranges(ranges, expected)
        assert np.isfinite(ranges[0])


def test_corner_exactly_on_the_seam_leaves_no_gap():
    laser = Laser(n_beams=8, fov_rad=2 * math.pi)
    walls = [[-3, 0, -3, 4], [-3, -4, -3, 0]]
    assert SegmentCaster(world_of(walls), laser).cast([0, 0, 0])[0] == pytest.approx(3.0)
    for wall in walls:  # each alone, too: ends are closed
        assert SegmentCaster(world_of([wall]), laser).cast([0, 0, 0])[0] == pytest.approx(3.0)


def test_no_gap_between_walls_that_share_a_corner():
    rng = np.random.default_rng(5)
    laser = Laser(n_beams=720, fov_rad=2 * math.pi)
    for _ in range(20):  # a ring whose corners lie exactly on beams
        radius = rng.uniform(0.5, 30.0, 90)
        angle = laser.bearings_rad[::8]
        ring = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
        walls = chain(np.append(ring, ring[:1], axis=0))
        ranges = SegmentCaster(world_of(rng.permutation(walls)), laser).cast([0, 0, 0])
        np.testing.assert_allclose(ranges[::8], radius, atol=1e-9)
        assert np.all(np.isfinite(ranges))


def test_beam_along_a_wall_hits_its_nearer_end():
    laser = Laser(n_beams=3, fov_rad=1.0)
    for wall in ([2, 0, 5, 0], [5, 0, 2, 0]):
        ranges = SegmentCaster(world_of([wall]), laser).cast([0, 0, 0])
        assert_equal_ranges(ranges, np.array([np.inf, 2.0, np.inf]))
    rng = np.random.default_rng(2)
    for heading in rng.uniform(-np.pi, np.pi, 50):
        d = np.array([np.cos(heading), np.sin(heading)])
        wall = [*(2 * d), *(5 * d)]
        middle = SegmentCaster(world_of([wall]), laser).cast([0, 0, heading])[1]
        assert 2.0 - 1e-9 <= middle <= 5.0 + 1e-9


def test_sensor_behind_the_end_of_a_wall_on_its_line_sees_others():
    laser = Laser(n_beams=181)
    walls = np.array([[-5.0, 0, -1, 0], [4, -9, 4, 9]])
    expected = slow_ranges(walls[1:], np.zeros(3), laser.bearings_rad, 80.0)
    assert_equal_ranges(SegmentCaster(world_of(walls), laser).cast([0, 0, 0]), expected)


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("fov_rad", [1.0, 2 * math.pi])
def test_sensor_on_a_wall_has_range_zero(share, fov_rad):
    a, b = np.array([1.0, 2.0]), np.array([4.0, 6.0])
    laser = Laser(n_beams=16, fov_rad=fov_rad)
    ranges = SegmentCaster(world_of([[*a, *b]]), laser).cast([*(a + share * (b - a)), 0.3])
    np.testing.assert_array_equal(ranges, 0.0)


def test_a_lone_beam_from_a_sensor_on_a_wall_has_range_zero():
    caster = SegmentCaster(world_of([[-1.0, -1, 1, 1]]), Laser(n_beams=1, fov_rad=1.0))
    for heading in (0.0, 2.0, -2.0):
        assert caster.cast([0.25, 0.25, heading]).tolist() == [0.0]


@pytest.mark.parametrize("gap", [1e-11, 1e-9, 1e-6, 1e-3])
def test_sensor_close_to_a_wall_sees_it_on_one_side_only(gap):
    laser = Laser(n_beams=12, fov_rad=2 * math.pi)
    ranges = SegmentCaster(world_of([[-30, gap, 40, gap]]), laser).cast([0, 0, 0.1])
    height = np.sin(laser.bearings_rad + 0.1)
    assert_equal_ranges(ranges, np.where(height > 0, gap / np.where(height > 0, height, 1), np.inf))


def test_poses_that_cannot_be_cast_from():
    caster = SegmentCaster(world_of([[1, -1, 1, 1]]), Laser(n_beams=3))
    for bad in ([np.nan, 0, 0], [0, np.inf, 0], [0, 0, np.nan]):
        with pytest.raises(ValueError, match="finite"):
            caster.cast(bad)
    for bad in ([0, 0], [[0, 0, 0], [1, 1, 1]]):
        with pytest.raises(ValueError, match="one pose"):
            caster.cast(bad)
    with pytest.raises(ValueError, match=r"\(N, 3\)"):
        caster.cast_many([0, 0, 0])
    assert caster.cast_many(np.zeros((0, 3))).shape == (0, 3)


seeds = st.integers(0, 2**32 - 1)
poses = st.tuples(st.floats(-9, 9), st.floats(-9, 9), st.floats(-7, 7)).map(np.array)
full_circle = Laser(n_beams=64, fov_rad=2 * math.pi, max_range_m=80.0)


@settings(max_examples=60, deadline=None)
@given(seeds, poses, poses)
def test_moving_world_and_sensor_together_changes_nothing(seed, pose, motion):
    walls = random_walls(np.random.default_rng(seed))
    cos, sin = np.cos(motion[2]), np.sin(motion[2])
    turned = walls.reshape(-1, 2) @ np.array([[cos, sin], [-sin, cos]]) + motion[:2]
    before = SegmentCaster(world_of(walls), full_circle).cast(pose)
    after = SegmentCaster(world_of(turned.reshape(-1, 4)), full_circle).cast(compose(motion, pose))
    # where a beam misses corners and does not graze; a graze magnifies rounding
    clear = clear_of_corners(walls, pose, full_circle.bearings_rad, 1e-6)
    assert_equal_ranges(after[clear], before[clear], 1e-7)


@settings(max_examples=60, deadline=None)
@given(seeds, poses)
def test_another_wall_never_lengthens_a_range(seed, pose):
    rng = np.random.default_rng(seed)
    walls = random_walls(rng)
    more = np.insert(walls, rng.integers(len(walls)), rng.uniform(-9, 9, 4), axis=0)
    before = SegmentCaster(world_of(walls), full_circle).cast(pose)
    after = SegmentCaster(world_of(more), full_circle).cast(pose)
    alone = [SegmentCaster(world_of(part), full_circle).cast(pose) for part in (walls, more)]
    assert np.all(after <= before + 1e-12)
    np.testing.assert_array_equal(alone, [before, after])


@settings(max_examples=60, deadline=None)
@given(seeds, poses, st.floats(0.01, 100.0))
def test_ranges_scale_with_the_world(seed, pose, scale):
    walls = random_walls(np.random.default_rng(seed))
    far = Laser(n_beams=64, fov_rad=2 * math.pi, max_range_m=1e4)
    before = SegmentCaster(world_of(walls), far).cast(pose)
    after = SegmentCaster(world_of(walls * scale), far).cast(pose * [scale, scale, 1.0])
    clear = clear_of_corners(walls, pose, far.bearings_rad, 1e-6)
    assert_equal_ranges(after[clear] / scale, before[clear], 1e-7)


@settings(max_examples=40, deadline=None)
@given(seeds, poses)
def test_turning_the_sensor_by_whole_beams_rolls_the_scan(seed, pose):
    walls = random_walls(np.random.default_rng(seed))
    caster = SegmentCaster(world_of(walls), full_circle)
    clear = clear_of_corners(walls, pose, full_circle.bearings_rad, 1e-6)
    before = caster.cast(pose)
    after = np.roll(caster.cast(pose + np.array([0, 0, 10 * np.pi / 64])), 5)
    assert_equal_ranges(after[clear], before[clear], 1e-7)


def test_a_wall_cut_in_pieces_is_the_same_wall():
    rng = np.random.default_rng(8)
    laser = Laser(n_beams=500, fov_rad=2 * math.pi)
    for _ in range(30):
        a, b, pose = rng.uniform(-9, 9, 2), rng.uniform(-9, 9, 2), rng.uniform(-9, 9, 3)
        cuts = np.concatenate([[0.0], np.sort(rng.random(6)), [1.0]])[:, None]
        whole = SegmentCaster(world_of([[*a, *b]]), laser).cast(pose)
        pieces = SegmentCaster(world_of(chain(a + cuts * (b - a))), laser).cast(pose)
        assert_equal_ranges(pieces, whole, 1e-8)


def slow_lidar(world, lidar, pose):
    """Every ray against every face and the ground, in 3D."""
    ranges = np.full((lidar.n_rings, lidar.n_azimuths), np.inf)
    z = lidar.mount.z_m
    for i, elevation in enumerate(lidar.elevations_rad):
        for j, azimuth in enumerate(lidar.azimuths_rad + pose[2]):
            d = np.array([math.cos(azimuth), math.sin(azimuth)]) * math.cos(elevation)
            up = math.sin(elevation)
            best = -z / up if up * z < 0 else np.inf
            for wall, (bottom, top) in zip(world.walls, world.wall_z_m, strict=True):
                a, along = wall[:2], wall[2:] - wall[:2]
                r, t = np.linalg.solve(np.column_stack([d, -along]), a - pose[:2])
                if r >= 0 and 0 <= t <= 1 and bottom <= z + r * up <= top:
                    best = min(best, r)
            ranges[i, j] = best if best <= lidar.max_range_m else np.inf
    return ranges


@pytest.mark.parametrize("height", [0.0, 1.5, 4.0])
def test_lidar_against_slow_geometry(height):
    rng = np.random.default_rng(int(height * 10))
    lidar = Lidar3D(n_rings=6, n_azimuths=41, max_range_m=14.0, mount=Mount(z_m=height))
    walls = random_walls(rng, n_boxes=4, n_lone=3)
    bottom = rng.choice([0.0, 0.5, 2.0], len(walls))
    world = world_of(walls, np.column_stack([bottom, bottom + rng.uniform(0.3, 3.0, len(walls))]))
    for pose in rng.uniform(-8, 8, (2, 3)):
        expected, got = slow_lidar(world, lidar, pose), cast_lidar(world, lidar, pose)
        if height == 0.0:  # it stands in the ground plane: downward rings end at once
            np.testing.assert_array_equal(got[lidar.elevations_rad < 0], 0.0)
            expected, got = (a[lidar.elevations_rad > 0] for a in (expected, got))
        assert 0.05 < np.mean(np.isfinite(got)) < 1.0 or height == 0.0
        assert_equal_ranges(got, expected)


def test_lidar_looks_over_a_low_face_into_the_one_behind():
    lidar = Lidar3D(n_rings=3, n_azimuths=4, mount=Mount(z_m=1.0))
    world = world_of([[2, -1, 2, 1], [4, -1, 4, 1]], [[0.0, 0.9], [0.0, 3.0]])
    ranges = cast_lidar(world, lidar, [0, 0, 0])
    slope = math.tan(math.radians(15))
    down = min(2.0, 1.0 / slope) / math.cos(math.radians(15))
    np.testing.assert_allclose(ranges[:, 2], [down, 4.0, 4.0 / math.cos(math.radians(15))])
    assert np.all(np.isinf(ranges[1:, [0, 1, 3]]))
    np.testing.assert_allclose(ranges[0, [0, 1, 3]], 1.0 / math.sin(math.radians(15)))


def slow_visible(world, origin, points):
    seen = np.ones(len(points), bool)
    for k, point in enumerate(points):
        ray = point - origin
        for wall, (bottom, top) in zip(world.walls, world.wall_z_m, strict=True):
            a, along = wall[:2], wall[2:] - wall[:2]
            s, t = np.linalg.solve(np.column_stack([ray[:2], -along]), a - origin[:2])
            on_face = 0 <= t <= 1 and bottom <= origin[2] + s * ray[2] <= top
            if 0 <= s <= 1 and on_face and (1 - s) * np.linalg.norm(ray) >= 0.005:
                seen[k] = False
    return seen


def test_visible_against_slow_geometry():
    rng = np.random.default_rng(3)
    walls = random_walls(rng)
    world = world_of(
        walls, np.column_stack([np.zeros(len(walls)), rng.uniform(0.5, 2, len(walls))])
    )
    points = np.column_stack([rng.uniform(-10, 10, (300, 2)), rng.uniform(0, 3, 300)])
    for origin in ([0.0, 0.0, 0.5], [5.0, -7.0, 1.4], [-3.0, 2.0, 2.9]):
        seen = visible(world, origin, points)
        np.testing.assert_array_equal(seen, slow_visible(world, np.array(origin), points))
        assert 0.02 < seen.mean() < 0.98


def test_visible_points_on_a_face_and_behind_it():
    world = world_of([[2, -1, 2, 1]])
    points = [[2, 0, 0.5], [2.004, 0, 0.5], [2.006, 0, 0.5], [1, 0, 0.5], [3, 0, 0.5], [3, 0, 2.6]]
    seen = visible(world, [0, 0, 0.5], points)
    assert seen.tolist() == [True, True, False, True, False, True]
    # a box hides what stands beyond its shared corner, and its far faces
    world = world_of(box(3, 0, 1, 1, np.pi / 4))
    corner = 3 - math.sqrt(2)
    points = [[corner, 0, 0.5], [5, 0, 0.5], [3 + math.sqrt(2), 0, 0.5], [corner, 0, 3]]
    assert visible(world, [0, 0, 0.5], points).tolist() == [True, False, False, True]


def test_visible_agrees_with_the_ranges():
    rng = np.random.default_rng(11)
    walls = random_walls(rng)
    world, pose = world_of(walls), np.array([0.5, -0.2, 0.4])
    ranges = SegmentCaster(world, full_circle).cast(pose)
    angles = (full_circle.bearings_rad + pose[2])[np.isfinite(ranges)]
    ranges = ranges[np.isfinite(ranges)]
    for change, expected in ((-0.02, True), (0.02, False)):
        r = ranges + change
        points = np.stack([pose[0] + r * np.cos(angles), pose[1] + r * np.sin(angles)], axis=1)
        points = np.column_stack([points, np.full(len(points), Z)])
        np.testing.assert_array_equal(visible(world, [*pose[:2], Z], points), expected)


def test_no_points_and_no_walls():
    world = world_of(np.zeros((0, 4)))
    assert visible(world, [0, 0, 0], [[1, 2, 3]]).tolist() == [True]
    assert visible(world, [0, 0, 0], np.zeros((0, 3))).shape == (0,)
    lidar = Lidar3D(n_rings=2, n_azimuths=3)
    assert np.isfinite(cast_lidar(world, lidar, [0, 0, 0])).any(axis=1).tolist() == [True, False]
