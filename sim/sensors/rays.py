"""Rays in a world: by the exact caster, or by the physics engine; the geometry is the same."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from sim.arrays import Array, Bools
from sim.people.walk import Crowd
from sim.robot.base import Robot
from sim.se2 import transform
from sim.sensors.base import Hits, Rays
from sim.worlds.world import Material, World

_SURFACE_M = 0.005  # a landmark this near the face that a ray hits is seen


class ExactRays:
    """The caster of `sim.sensors.casting`, imported only where it is used: it needs a compiler."""

    def __init__(self, world: World) -> None:
        self._world, self._opaque = world, world
        if world.materials is not None:
            solid = world.materials != Material.GLASS
            self._opaque = World(world.name, world.walls[solid], world.wall_z_m[solid])
        self._casters: dict[Any, Any] = {}

    def scan(self, scanner: Any, pose: Array) -> Array:
        """Ranges (beams,) m of a scanner on the robot at a pose (3,); inf without a return."""
        if scanner not in self._casters:
            from sim.sensors.casting import SegmentCaster

            self._casters[scanner] = SegmentCaster(self._world, scanner)
        return np.asarray(self._casters[scanner].cast(scanner.mount.in_map(pose)))

    def cloud(self, lidar: Any, pose: Array) -> Array:
        """Ranges (rings, azimuths) m of a lidar on the robot at a pose (3,)."""
        from sim.sensors.casting import cast_lidar

        return cast_lidar(self._world, lidar, lidar.mount.in_map(pose))

    def sees(self, origin: Array, points: Array) -> Bools:
        """Whether nothing stands between a point (3,) and each of others (K, 3)."""
        from sim.sensors.casting import visible

        return visible(self._opaque, origin, points)

    def hits(self, scanner: Any, eyes: Array, bearings_rad: Array, stamps: Array) -> Hits:
        """What beams (B,) hit, each with its own pose of the scanner (B, 3), bearing and time."""
        from sim.sensors.beams import cast_beams

        return cast_beams(self._world, scanner, eyes, bearings_rad)


class AmongFaces:
    """Rays in a world in which faces move: robots, each a box of its body's size, and doors.

    Parameters
    ----------
    rays
        Those of the world alone.
    faces
        Gives the faces (K, 4), and their bottoms and tops (K, 2), m, as they are now.
    """

    def __init__(self, rays: Rays, faces: Callable[[], tuple[Array, Array]]) -> None:
        self._rays, self._faces = rays, faces

    def _boxes(self) -> ExactRays:
        return ExactRays(World("moving", *self._faces()))

    def scan(self, scanner: Any, pose: Array) -> Array:
        """Ranges (beams,) m of a scanner on the robot at a pose (3,); inf without a return."""
        return np.minimum(self._rays.scan(scanner, pose), self._boxes().scan(scanner, pose))

    def cloud(self, lidar: Any, pose: Array) -> Array:
        """Ranges (rings, azimuths) m of a lidar on the robot at a pose (3,)."""
        return np.minimum(self._rays.cloud(lidar, pose), self._boxes().cloud(lidar, pose))

    def sees(self, origin: Array, points: Array) -> Bools:
        """Whether nothing stands between a point (3,) and each of others (K, 3)."""
        return self._rays.sees(origin, points) & self._boxes().sees(origin, points)

    def hits(self, scanner: Any, eyes: Array, bearings_rad: Array, stamps: Array) -> Hits:
        """What beams (B,) hit, each with its own pose of the scanner (B, 3), bearing and time."""
        there = self._rays.hits(scanner, eyes, bearings_rad, stamps)
        return there.nearer(self._boxes().hits(scanner, eyes, bearings_rad, stamps))


def robot_faces(others: Sequence[tuple[Robot, Array]]) -> tuple[Array, Array]:
    """Sides (4 n, 4) of the bodies of robots at poses (3,), and bottoms and tops (4 n, 2), m."""
    faces = np.concatenate([np.zeros((0, 4)), *(_sides(*other) for other in others)])
    heights_m = np.repeat([robot.body_height_m for robot, _ in others], 4)
    return faces, np.stack([0.0 * heights_m, heights_m], axis=1)


def _sides(robot: Robot, pose: Array) -> Array:
    """Sides (4, 4) of a robot's body, seen from above, m in map."""
    x, y = robot.body_length_m / 2, robot.body_width_m / 2
    corners = transform(pose, np.array([[x, y], [-x, y], [-x, -y], [x, -y]]))
    return np.hstack([corners, np.roll(corners, -1, axis=0)])


class AmongPeople:
    """Rays in a world in which people walk: legs below, a torso above, upright and round.

    Parameters
    ----------
    rays
        Those of the world, and of the robots in it.
    """

    def __init__(self, rays: Rays, crowd: Crowd) -> None:
        self._rays, self._crowd = rays, crowd

    def scan(self, scanner: Any, pose: Array) -> Array:
        """Ranges (beams,) m of a scanner on the robot at a pose (3,); inf without a return."""
        eye = scanner.mount.in_map(pose)
        discs = self._crowd.discs(np.array(self._crowd.now_s), scanner.mount.z_m)
        to_people, _ = strike_discs(eye[:2], eye[2] + scanner.bearings_rad, discs)
        to_people[to_people > scanner.max_range_m] = np.inf
        return np.minimum(self._rays.scan(scanner, pose), to_people)

    def cloud(self, lidar: Any, pose: Array) -> Array:
        """Ranges (rings, azimuths) m of a lidar on the robot at a pose (3,)."""
        eye, elevations = lidar.mount.in_map(pose), lidar.elevations_rad[:, None]
        found = self._rays.cloud(lidar, pose)
        for discs, bottom_m, top_m in self._cylinders():
            away, _ = strike_discs(eye[:2], eye[2] + lidar.azimuths_rad, discs)
            height = lidar.mount.z_m + np.where(np.isfinite(away), away, 0.0) * np.tan(elevations)
            hit = (bottom_m <= height) & (height <= top_m)
            slant = away / np.cos(elevations)
            found = np.minimum(found, np.where(hit & (slant <= lidar.max_range_m), slant, np.inf))
        return found

    def sees(self, origin: Array, points: Array) -> Bools:
        """Whether nothing stands between a point (3,) and each of others (K, 3)."""
        seen = self._rays.sees(origin, points)
        offsets = points - origin
        level_m = np.maximum(np.hypot(*offsets[:, :2].T), 1e-9)
        angles = np.arctan2(offsets[:, 1], offsets[:, 0])
        for discs, bottom_m, top_m in self._cylinders():
            away, _ = strike_discs(origin[:2], angles, discs)
            share = np.where(np.isfinite(away), away / level_m, 2.0)
            height = origin[2] + share * offsets[:, 2]
            seen &= ~((share < 1.0) & (bottom_m <= height) & (height <= top_m))
        return seen

    def hits(self, scanner: Any, eyes: Array, bearings_rad: Array, stamps: Array) -> Hits:
        """What beams (B,) hit, each with its own pose of the scanner (B, 3), bearing and time."""
        discs = self._crowd.discs(stamps, scanner.mount.z_m)
        ranges, cosines = strike_discs(eyes[:, :2], eyes[:, 2] + bearings_rad, discs)
        ranges[ranges > scanner.max_range_m] = np.inf
        people = Hits(ranges, cosines, np.full(len(ranges), Material.PLASTER, np.int64))
        return self._rays.hits(scanner, eyes, bearings_rad, stamps).nearer(people)

    def _cylinders(self) -> list[tuple[Array, float, float]]:
        """Circles (K, 3) of the legs and of the torsos, and their heights from and to, m."""
        people, now = self._crowd.people, np.array(self._crowd.now_s)
        split_m = people.legs_top_m
        legs, torsos = self._crowd.discs(now, split_m), self._crowd.discs(now, people.height_m)
        return [(legs, 0.0, split_m), (torsos, split_m, people.height_m)]


def strike_discs(origins: Array, angles_rad: Array, discs: Array) -> tuple[Array, Array]:
    """Ranges (B,) m, and cosines of incidence, of beams to the nearest of upright cylinders.

    Parameters
    ----------
    origins
        (2,) m, or (B, 2), one a beam.
    angles_rad
        (B,) of the beams in map.
    discs
        (K, 3) x, y and radius, m; or (B, K, 3), as they are for each beam. The range is inf where
        none is hit, and 0 from within.
    """
    if discs.shape[-2] == 0:
        return np.full(len(angles_rad), np.inf), np.zeros(len(angles_rad))
    offset = discs[..., :2] - origins[..., None, :]  # (K, 2) or (B, K, 2)
    x, y = offset[..., 0], offset[..., 1]
    cos, sin = np.cos(angles_rad)[:, None], np.sin(angles_rad)[:, None]
    along, across = cos * x + sin * y, cos * y - sin * x
    radius = np.broadcast_to(discs[..., 2], along.shape)
    half = np.sqrt(np.maximum(radius**2 - across**2, 0.0))
    hit = (np.abs(across) <= radius) & (along + half >= 0.0)
    ranges = np.where(hit, np.maximum(along - half, 0.0), np.inf)
    first = np.argmin(ranges, axis=1)[:, None]
    nearest, cosines = (np.take_along_axis(a, first, axis=1)[:, 0] for a in (ranges, half / radius))
    return nearest, cosines


class BulletRays:
    """The physics engine's rays."""

    def __init__(self, bullet: Any) -> None:
        self._bullet = bullet

    def scan(self, scanner: Any, pose: Array) -> Array:
        """Ranges (beams,) m of a scanner on the robot at a pose (3,); inf without a return."""
        planar = scanner.mount.in_map(pose)
        angles = planar[2] + scanner.bearings_rad
        starts = np.tile([planar[0], planar[1], scanner.mount.z_m], (len(angles), 1))
        way = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=-1)
        return self._ranges(starts, way, scanner.max_range_m, ground=False)

    def cloud(self, lidar: Any, pose: Array) -> Array:
        """Ranges (rings, azimuths) m of a lidar on the robot at a pose (3,)."""
        planar = lidar.mount.in_map(pose)
        elevation = np.repeat(lidar.elevations_rad, lidar.n_azimuths)
        azimuth = np.tile(planar[2] + lidar.azimuths_rad, lidar.n_rings)
        flat = np.cos(elevation)
        way = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1)
        starts = np.tile([planar[0], planar[1], lidar.mount.z_m], (len(way), 1))
        ranges = self._ranges(starts, way, lidar.max_range_m, ground=True)
        return ranges.reshape(lidar.n_rings, lidar.n_azimuths)

    def sees(self, origin: Array, points: Array) -> Bools:
        """Whether nothing stands between a point (3,) and each of others (K, 3)."""
        if len(points) == 0:
            return np.zeros(0, bool)
        distance = np.linalg.norm(points - origin, axis=1)
        share = self._bullet.cast(np.broadcast_to(origin, points.shape), points)
        return np.asarray(share * distance >= distance - _SURFACE_M)

    def hits(self, scanner: Any, eyes: Array, bearings_rad: Array, stamps: Array) -> Hits:
        """What beams (B,) hit, each with its own pose of the scanner (B, 3), bearing and time.

        The engine knows no materials.
        """
        angles = eyes[:, 2] + bearings_rad
        starts = np.column_stack([eyes[:, :2], np.full(len(eyes), scanner.mount.z_m)])
        way = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=-1)
        share, normals = self._bullet.strike(starts, starts + scanner.max_range_m * way)
        ranges = np.where(share < 1.0, share * scanner.max_range_m, np.inf)
        cosines = np.abs(np.sum(way * normals, axis=1))
        return Hits(ranges, cosines, np.full(len(way), Material.PLASTER, np.int64))

    def _ranges(self, starts: Array, way: Array, reach_m: float, *, ground: bool) -> Array:
        share = self._bullet.cast(starts, starts + reach_m * way, ground=ground)
        return np.where(share < 1.0, share * reach_m, np.inf)
