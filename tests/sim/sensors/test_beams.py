"""Beams with origins of their own, their noise, and what they hit, against sums of their own."""

import dataclasses

import numpy as np
import pytest

from sim.errors import InputError
from sim.sensors import Laser, Mount, RealLaser, View
from sim.sensors.beams import cast_beams
from sim.sensors.casting import SegmentCaster
from sim.sensors.rays import ExactRays, strike_discs
from sim.worlds.irregular import Clutter
from sim.worlds.world import Material, World

ROOM = World(
    "room",
    np.array([[0, 0, 8, 0], [8, 0, 8, 6], [8, 6, 0, 6], [0, 6, 0, 0.0]]),
    np.tile([0.0, 2.5], (4, 1)),
)
HERE = np.array([3.0, 2.0, 0.3])


def view(world, pose=HERE, past=None, stamp=1.0):
    return View(stamp, pose, world, ExactRays(world), 0.0, pose, {}, past)


def one_by_one(walls, origins, angles):
    """Ranges (B,) by solving each beam against each face."""
    ranges = np.full(len(angles), np.inf)
    for row, (origin, angle) in enumerate(zip(origins, angles, strict=True)):
        way = np.array([np.cos(angle), np.sin(angle)])
        for x1, y1, x2, y2 in walls:
            matrix = np.array([way, [x1 - x2, y1 - y2]]).T
            if abs(np.linalg.det(matrix)) > 1e-12:
                far, place = np.linalg.solve(matrix, np.array([x1, y1]) - origin)
                if far >= 0.0 and 0.0 <= place <= 1.0:
                    ranges[row] = min(ranges[row], far)
    return ranges


@pytest.mark.parametrize("fov", [np.pi, 2.0 * np.pi])
def test_beams_from_many_origins_meet_what_solving_finds(fov):
    rng = np.random.default_rng(3)
    world = Clutter(n_tables=1, n_plants=1, n_boxes=4, n_landmarks=0).build(rng)
    laser = Laser(n_beams=60, fov_rad=fov, mount=Mount(z_m=0.25))
    low = (world.wall_z_m[:, 0] <= 0.25) & (world.wall_z_m[:, 1] >= 0.25)
    for moved, turned in ((0.0, 0.0), (0.2, 0.15), (1.5, 0.5)):
        eyes = np.array([9.0, 6.0, 1.0]) + np.outer(np.linspace(0, 1, 60), [moved, -moved, turned])
        hits = cast_beams(world, laser, eyes, laser.bearings_rad)
        expected = one_by_one(world.walls[low], eyes[:, :2], eyes[:, 2] + laser.bearings_rad)
        assert np.allclose(hits.ranges_m, expected, atol=1e-9)


def test_a_scan_at_one_instant_is_the_other_casters():
    world = Clutter(n_landmarks=0).build(np.random.default_rng(1))
    laser = Laser(mount=Mount(z_m=0.25), max_range_m=6.0)
    eyes = np.tile([9.0, 6.0, 1.0], (721, 1))
    ranges = cast_beams(world, laser, eyes, laser.bearings_rad).ranges_m
    assert np.allclose(ranges, SegmentCaster(world, laser).cast(eyes[0]), atol=1e-9)


def test_incidence_is_the_angle_to_the_normal():
    laser = Laser(n_beams=3, fov_rad=1.0)
    hits = view(ROOM, np.array([4.0, 3.0, 0.0])).hits(laser)
    assert np.allclose(hits.cos_incidence, np.cos([-0.5, 0.0, 0.5]))


@pytest.mark.parametrize(("passes", "spacing_s"), [(1, 0.0), (4, 1.0 / 75.0)])
def test_a_sweep_ends_at_its_stamp(passes, spacing_s):
    laser = Laser(rate_hz=18.75, sweep_s=1.0 / 150.0, interlaced=passes)
    times = laser.beam_offsets_s
    assert times.max() == 0.0
    assert times[720] - times[0] == pytest.approx(1.0 / 150.0)  # both of the first pass
    assert times[1] - times[0] == pytest.approx(spacing_s + 1.0 / 150.0 / 720)
    assert not Laser().beam_offsets_s.any()


def test_each_beam_of_a_sweep_is_cast_from_where_the_robot_was():
    laser = Laser(n_beams=181, sweep_s=0.1)
    times, speed = np.linspace(0.9, 1.0, 31), np.array([2.0, 0.5, 1.5])
    past = times, HERE + np.outer(times - 1.0, speed)
    swept = view(ROOM, HERE, past).scan(laser)
    poses = HERE + np.outer(laser.beam_offsets_s, speed)
    angles = poses[:, 2] + laser.bearings_rad
    expected = one_by_one(ROOM.walls, poses[:, :2], angles)
    assert np.allclose(swept, expected, atol=1e-9)
    still = view(ROOM).scan(dataclasses.replace(laser, sweep_s=0.0))
    assert np.abs(swept - still).max() > 0.05


def test_noise_and_bias_are_those_stated():
    laser = RealLaser(
        n_beams=5, fov_rad=2.0, sigma_range_m=0.01, sigma_share=0.004, divergence_rad=0.02,
        bias_m=0.02, bias_share=-0.003, bias_incidence_m=0.01,
    )  # fmt: skip
    probe, seen = laser.start(np.random.default_rng(0)), view(ROOM, np.array([1.0, 3.0, 0.0]))
    drawn = np.array([probe(seen)["ranges_m"] for _ in range(4000)], float)
    hits = seen.hits(laser)
    tan = np.tan(np.arccos(hits.cos_incidence))
    sigma = np.sqrt(1e-4 + (0.004 * hits.ranges_m) ** 2 + (hits.ranges_m * 0.005 * tan) ** 2)
    bias = 0.02 - 0.003 * hits.ranges_m + 0.01 * (1.0 / hits.cos_incidence - 1.0)
    assert np.allclose(drawn.std(axis=0), sigma, rtol=0.05)
    assert np.allclose(drawn.mean(axis=0) - hits.ranges_m, bias, atol=4.0 * sigma.max() / 63.0)


def test_beams_half_on_an_edge_blend_up_to_a_jump():
    post = np.array([[4.0, 2.9, 4.0, 3.1]])
    world = dataclasses.replace(
        ROOM, walls=np.vstack([ROOM.walls, post]), wall_z_m=np.tile([0.0, 2.5], (5, 1))
    )
    beams = {"n_beams": 721, "fov_rad": 0.4, "sigma_range_m": 0.0, "divergence_rad": 0.01}
    pose = np.array([1.0, 3.0, 0.0])

    def between(mixed_m):
        probe = RealLaser(**beams, mixed_m=mixed_m).start(np.random.default_rng(0))
        ranges = probe(view(world, pose))["ranges_m"]
        return int(np.sum((ranges > 3.1) & (ranges < 6.9)))

    # two edges, each 0.01 rad wide, of beams 0.4 / 720 rad apart
    assert between(5.0) == pytest.approx(2 * 0.01 / (0.4 / 720), abs=4)
    assert between(2.0) == 0
    assert between(0.0) == 0
    with pytest.raises(InputError, match="divergence_rad"):
        RealLaser(mixed_m=1.0)


def test_glass_returns_at_right_angles_alone_and_dark_faces_near_by():
    kinds = np.array([0, Material.GLASS, Material.DARK, 0])
    behind = np.array([[10.0, -10.0, 10.0, 20.0]])
    world = World(
        "glass", np.vstack([ROOM.walls, behind]), np.tile([0.0, 2.5], (5, 1)),
        materials=np.append(kinds, 0),
    )  # fmt: skip
    laser = RealLaser(
        n_beams=181, sigma_range_m=0.0, glass_angle_rad=0.2, reach_at_10_percent_m=4.0
    )
    ranges = laser.start(np.random.default_rng(0))(view(world, np.array([5.0, 3.0, 0.0])))
    ranges, bearings = ranges["ranges_m"], laser.bearings_rad
    ahead = np.abs(bearings) < 0.6
    at_pane = np.isclose(ranges * np.cos(bearings), 3.0, atol=1e-5)
    through = np.isclose(ranges * np.cos(bearings), 5.0, atol=1e-5)
    assert np.array_equal(at_pane[ahead], np.abs(bearings[ahead]) < 0.2)
    assert np.array_equal(through[ahead], np.abs(bearings[ahead]) >= 0.2)
    reach = 4.0 * np.sqrt(0.024 / 0.1)  # of the dark wall, 3 m to the left, at a right angle
    assert reach < 3.0
    assert np.isinf(ranges[-1])
    plain = RealLaser(n_beams=181, sigma_range_m=0.0).start(np.random.default_rng(0))
    assert plain(view(world, np.array([5.0, 3.0, 0.0])))["ranges_m"][-1] == pytest.approx(3.0)
    eye, beyond = np.array([5.0, 3.0, 1.0]), np.array([[9.0, 3.0, 1.0], [5.0, 7.0, 1.0]])
    assert ExactRays(world).sees(eye, beyond).tolist() == [True, False]


def test_nothing_seen_is_one_value():
    laser = RealLaser(max_range_m=3.0, nothing_m=3.5)
    ranges = laser.start(np.random.default_rng(0))(view(ROOM))["ranges_m"]
    assert np.isfinite(ranges).all()
    assert (ranges == 3.5).any()
    assert not laser.returned(ranges[ranges == 3.5]).any()
    assert len(laser.points_in_base({"ranges_m": ranges})) == laser.returned(ranges).sum()
    with pytest.raises(InputError, match="nothing_m"):
        RealLaser(nothing_m=5.0)


def test_discs_are_met_where_the_quadratic_says():
    rng = np.random.default_rng(5)
    discs = np.column_stack([rng.uniform(-5, 5, (12, 2)), rng.uniform(0.05, 0.5, 12)])
    discs = discs[np.hypot(*discs[:, :2].T) > 1.0]
    angles = rng.uniform(-np.pi, np.pi, 200)
    ranges, cosines = strike_discs(np.zeros(2), angles, discs)
    for angle, found, cosine in zip(angles, ranges, cosines, strict=True):
        way = np.array([np.cos(angle), np.sin(angle)])
        expected, normal = np.inf, way
        for x, y, radius in discs:
            roots = np.roots([1.0, -2.0 * way @ [x, y], x * x + y * y - radius**2])
            near = roots[np.isreal(roots)].real.min(initial=np.inf)
            if 0.0 < near < expected:
                expected, normal = near, (near * way - [x, y]) / radius
        assert found == pytest.approx(expected, abs=1e-9)
        if np.isfinite(expected):
            assert cosine == pytest.approx(abs(way @ normal), abs=1e-6)
