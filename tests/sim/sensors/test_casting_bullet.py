"""The exact caster against the physics engine's rays, in every world of `conf/world`."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import yaml

from experiments.runs.targets import make
from sim.robot.bullet import BulletBody
from sim.robot.drive import DifferentialDrive
from sim.sensors import Laser, Lidar3D, Mount
from sim.sensors.rays import BulletRays, ExactRays
from sim.worlds.world import World

pytestmark = pytest.mark.bullet

ROOT = Path(__file__).resolve().parents[3]
PRESETS = {p.stem: p for p in sorted((ROOT / "conf" / "world").glob("*.yaml"))}
WORLDS = {name: path for name, path in PRESETS.items() if name != "from_grid"}  # has no walls yet
LASER = Laser(fov_rad=2 * np.pi, n_beams=720)
LIDAR = Lidar3D(mount=Mount(z_m=0.6))
TOLERANCE_M = 1e-3
STRETCH = 2e-4  # the engine takes a triangle to reach farther by 1e-4 of its size
EDGE_M = 0.02  # where a ray hits that margin of a face
ROUNDING_M = 1e-4  # and rounds to single precision, 3e-5 m at the far end of the campus


def stretched(world):
    """The world with every face a little larger on all sides."""
    along = world.walls[:, 2:] - world.walls[:, :2]
    along = along * (STRETCH + ROUNDING_M / np.hypot(*along.T))[:, None]
    up = STRETCH * np.diff(world.wall_z_m, axis=1) + ROUNDING_M
    return dataclasses.replace(
        world,
        walls=world.walls + np.hstack([-along, along]),
        wall_z_m=world.wall_z_m + np.hstack([-up, up]),
    )


@pytest.fixture(params=WORLDS, scope="module")
def both(request):
    config = yaml.safe_load(WORLDS[request.param].read_text())
    if "path" in config:
        config["path"] = str(ROOT / config["path"])
    rng = np.random.default_rng(7)
    made = make(config, "world", rng=rng)
    world = made if isinstance(made, World) else made.build(rng)
    robot = DifferentialDrive(wheel_radius_m=0.05, track_m=0.3)
    with BulletBody(world, robot, world.start_pose) as body:
        larger = ExactRays(stretched(world))
        yield world, ExactRays(world), larger, BulletRays(body)


def poses_on_tour(world, count):
    rng = np.random.default_rng(1)
    legs = rng.integers(0, len(world.waypoints) - 1, count)
    share = rng.random((count, 1))
    points = (1 - share) * world.waypoints[legs] + share * world.waypoints[legs + 1]
    return np.column_stack([points, rng.uniform(-np.pi, np.pi, count)])


def close(ranges, others, tolerance=TOLERANCE_M):
    with np.errstate(invalid="ignore"):
        return (np.abs(ranges - others) <= tolerance) | (np.isinf(ranges) & np.isinf(others))


def test_scans(both):
    world, exact, larger, bullet = both
    for pose in poses_on_tour(world, 8):
        expected = bullet.scan(LASER, pose)
        same = close(exact.scan(LASER, pose), expected)
        assert np.mean(same) > 0.99
        assert np.all(same | close(larger.scan(LASER, pose), expected, EDGE_M))


def test_clouds(both):
    world, exact, larger, bullet = both
    for pose in poses_on_tour(world, 2):
        expected = bullet.cloud(LIDAR, pose)
        same = close(exact.cloud(LIDAR, pose), expected)
        assert np.mean(same) > 0.99
        assert np.all(same | close(larger.cloud(LIDAR, pose), expected, EDGE_M))


def test_lines_of_sight(both):
    world, exact, larger, bullet = both
    for x, y, _ in poses_on_tour(world, 4) if len(world.landmarks) else []:
        origin = np.array([x, y, 0.5])
        seen, expected = (rays.sees(origin, world.landmarks) for rays in (exact, bullet))
        same = seen == expected
        assert np.mean(same) > 0.99
        assert np.all(same | (larger.sees(origin, world.landmarks) == expected))
