"""World + robot + sensors + route + random streams -> Recording.

Time runs in ticks of 1/300 s. At each tick the wheels are driven, slip, and are read; each
sensor fires at its own multiple of the tick.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from sim import se2
from sim.arrays import Array
from sim.errors import InputError
from sim.feedback import Feedback, feedback_of
from sim.kinematic import KinematicBody
from sim.recording import (
    CloudLog,
    CommandLog,
    LandmarkLog,
    LaserLog,
    Recording,
    Truth,
    WheelLog,
)
from sim.robot import DifferentialDrive, RobotGeometry, Slip
from sim.sensors import Laser, Lidar3D, SensorSuite, StereoCamera
from sim.world import World

Physics = Literal["bullet", "kinematic"]
Rays = Literal["bullet", "exact"]
_Logs = defaultdict[str, list[tuple[int, Any]]]  # of each sensor: tick and reading

TICKS_PER_S = 300
DT_S = 1.0 / TICKS_PER_S
_CHECK_EVERY = 6  # ticks between looks for collisions
_SLIP_EVENT_TICKS = 30
_SURFACE_M = 0.005  # a landmark this near the face that a ray hits is seen


class Body(Protocol):
    """What moves: PyBullet's robot or the kinematic one."""

    def step(self, wheel_speeds_mps: Array) -> Array:
        """Advance one tick; return the wheels' rolling (2,) m."""

    @property
    def pose(self) -> Array:
        """(3,) m, m, rad."""


class Driver(Protocol):
    """What commands a run, tick by tick."""

    def command(self, tick: int, pose: Array) -> Array | None:
        """Body velocity (2,) m/s, rad/s for the tick, or None when the route is done.

        The pose (3,) is the one that the route's feedback gives, the true one or a believed one.
        """

    @property
    def trouble(self) -> str | None:
        """`off_route` or `incomplete` if the route was not kept, else None."""


class Route(Protocol):
    """A plan that gives a Driver for a robot in a world.

    It may have an attribute `feedback`, see `sim.feedback`; without one its driver gets the truth.
    """

    def start(self, world: World, robot: DifferentialDrive) -> tuple[Array, Driver]:
        """Start pose (3,) and the driver."""


def record(
    world: World,
    robot: DifferentialDrive,
    sensors: SensorSuite,
    route: Route,
    streams: Mapping[str, np.random.Generator],
    *,
    physics: Physics = "bullet",
    rays: Rays = "bullet",
    config: dict[str, Any] | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> Recording:
    """Drive the route and record what the sensors measure.

    Parameters
    ----------
    streams
        Generators `slip` and `sensors`.
    physics
        `bullet`: rigid-body dynamics. `kinematic`: the same slip law with ideal rolling.
    rays
        `bullet`, or `exact` for the caster of `sim.casting`; the geometry is the same.
    config
        Kept in the recording: where it came from.
    on_progress
        Called about every simulated second with the simulated time, s.

    Returns
    -------
    Recording
        Its status is `ok`, or names what went wrong and when; the recording then ends there.

    Raises
    ------
    InputError
        If a sensor's rate does not divide 300 Hz, if the robot overlaps a wall at its start, or
        if Bullet rays are asked for without Bullet physics.
    """
    if rays == "bullet" and physics != "bullet":
        raise InputError("rays=bullet needs physics=bullet; set rays=exact")
    periods = _periods(sensors)
    pose, driver = route.start(world, robot)
    if overlaps(world, robot, pose):
        raise InputError(
            f"the robot overlaps a wall of world {world.name} at its start "
            f"({pose[0]:.2f}, {pose[1]:.2f}); move the start pose or the wall"
        )
    feedback = feedback_of(route, robot, pose)
    logs: _Logs = defaultdict(list)
    with contextlib.ExitStack() as stack:
        body: Body
        caster: ExactRays | BulletRays
        if physics == "bullet":
            from sim.bullet import BulletBody

            bullet = stack.enter_context(BulletBody(world, robot, pose))
            body, find_trouble = bullet, lambda: bullet.trouble
            caster = BulletRays(bullet) if rays == "bullet" else ExactRays(world, sensors.laser)
        else:
            body = KinematicBody(robot, pose)
            caster = ExactRays(world, sensors.laser)
            find_trouble = lambda: "collision" if overlaps(world, robot, body.pose) else None  # noqa: E731
        probes = _probes(world, sensors, caster, streams["sensors"])
        status = _drive(
            robot,
            periods,
            body,
            driver,
            feedback,
            find_trouble,
            probes,
            streams["slip"],
            logs,
            on_progress,
        )
    recording = _assemble(world, robot, sensors, logs, status, config or {})
    return dataclasses.replace(recording, robot=robot.nominal)


def _probes(
    world: World, sensors: SensorSuite, rays: ExactRays | BulletRays, rng: np.random.Generator
) -> dict[str, Callable[[Array], Any]]:
    """What each sensor measures, as a function of the robot's pose."""
    laser, stereo, lidar = sensors.laser, sensors.stereo, sensors.lidar3d
    probes: dict[str, Callable[[Array], Any]] = {}
    if laser:
        probes["laser"] = lambda pose: laser.measure(rays.scan(laser, pose), rng)
    if stereo:
        probes["stereo"] = partial(LandmarkEye(world, stereo, rng).observe, rays)
    if lidar:
        probes["lidar3d"] = lambda pose: lidar.measure(rays.cloud(lidar, pose), rng)
    return probes


def _drive(
    robot: DifferentialDrive,
    periods: dict[str, int],
    body: Body,
    driver: Driver,
    feedback: Feedback,
    find_trouble: Callable[[], str | None],
    probes: dict[str, Callable[[Array], Any]],
    rng: np.random.Generator,
    logs: _Logs,
    on_progress: Callable[[float], None] | None,
) -> str:
    """Run tick by tick until the route ends or something goes wrong; return the status."""
    slip = Slip.start(robot, DT_S)
    noise = _normals(rng)
    events = _SlipEvents(robot, rng)
    encoder, travel = np.zeros(2), np.zeros(2)
    tick, velocity = 0, np.zeros(2)
    while True:
        pose = body.pose
        due = [name for name, period in periods.items() if tick % period == 0]
        wanted = driver.command(tick, feedback.pose(tick, pose, encoder))
        if due or wanted is None:
            counts = robot.encoder_reading(encoder)
            logs["frames"].append((tick, (counts, travel.copy(), pose)))
        for name in due:
            if name in probes:
                logs[name].append((tick, probes[name](pose)))
        if wanted is None or tick % _CHECK_EVERY == 0:
            trouble = (find_trouble() if wanted is not None else None) or driver.trouble
            if trouble is not None:
                return f"{trouble} at {tick * DT_S:.2f} s near ({pose[0]:.2f}, {pose[1]:.2f})"
        if wanted is None:
            return "ok"
        if not np.array_equal(wanted, velocity) or tick == 0:
            velocity = wanted
            logs["commands"].append((tick, velocity))
        if on_progress is not None and tick % TICKS_PER_S == 0:
            on_progress(tick * DT_S)
        speeds = robot.wheel_speeds(velocity[0], velocity[1]) - slip.correction_mps
        rolling = body.step(speeds)
        encoder = encoder + slip.advance(rolling, next(noise), events.error(rolling))
        travel = travel + rolling
        tick += 1


def overlaps(world: World, robot: DifferentialDrive, pose: Array) -> bool:
    """Whether a wall that stands in the robot's height crosses its footprint (body and wheels)."""
    low = world.wall_z_m[:, 0] < robot.body_height_m
    if not np.any(low):
        return False
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    to_base = np.array([[cos, sin], [-sin, cos]])
    start = (world.walls[low, :2] - pose[:2]) @ to_base.T
    along = (world.walls[low, 2:] - pose[:2]) @ to_base.T - start
    half = np.array(
        [
            max(robot.body_length_m / 2, robot.wheel_radius_m),
            max(robot.body_width_m, robot.track_m) / 2,
        ]
    )
    # Clip each wall against the footprint's two slabs; what is left of it lies inside.
    with np.errstate(divide="ignore", invalid="ignore"):
        near, far = (-half - start) / along, (half - start) / along
    parallel = np.abs(along) < 1e-12
    outside = parallel & (np.abs(start) > half)
    enter = np.where(parallel, -np.inf, np.minimum(near, far)).max(axis=1)
    leave = np.where(parallel, np.inf, np.maximum(near, far)).min(axis=1)
    hit = (np.maximum(enter, 0.0) <= np.minimum(leave, 1.0)) & ~outside.any(axis=1)
    return bool(np.any(hit))


class ExactRays:
    """The caster of `sim.casting`, imported only where it is used: it needs a compiler."""

    def __init__(self, world: World, laser: Laser | None) -> None:
        self._world = world
        if laser is not None:
            from sim.casting import SegmentCaster

            self._caster = SegmentCaster(world, laser)

    def scan(self, laser: Laser, pose: Array) -> Array:
        """Ranges (beams,) m of a laser on the robot at a pose (3,); inf without a return."""
        return self._caster.cast(sensor_pose(laser, pose))

    def cloud(self, lidar: Lidar3D, pose: Array) -> Array:
        """Ranges (rings, azimuths) m of a lidar on the robot at a pose (3,)."""
        from sim.casting import cast_lidar

        return cast_lidar(self._world, lidar, sensor_pose(lidar, pose))

    def sees(self, origin: Array, points: Array) -> NDArray[np.bool_]:
        """Whether nothing stands between a point (3,) and each of others (K, 3)."""
        from sim.casting import visible

        return visible(self._world, origin, points)


class BulletRays:
    """The physics engine's rays."""

    def __init__(self, bullet: Any) -> None:
        self._bullet = bullet

    def scan(self, laser: Laser, pose: Array) -> Array:
        """Ranges (beams,) m of a laser on the robot at a pose (3,); inf without a return."""
        planar = sensor_pose(laser, pose)
        angles = planar[2] + laser.bearings_rad
        starts = np.tile([planar[0], planar[1], laser.mount.z_m], (laser.n_beams, 1))
        way = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=-1)
        return self._ranges(starts, way, laser.max_range_m, ground=False)

    def cloud(self, lidar: Lidar3D, pose: Array) -> Array:
        """Ranges (rings, azimuths) m of a lidar on the robot at a pose (3,)."""
        planar = sensor_pose(lidar, pose)
        elevation = np.repeat(lidar.elevations_rad, lidar.n_azimuths)
        azimuth = np.tile(planar[2] + lidar.azimuths_rad, lidar.n_rings)
        flat = np.cos(elevation)
        way = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1)
        starts = np.tile([planar[0], planar[1], lidar.mount.z_m], (len(way), 1))
        ranges = self._ranges(starts, way, lidar.max_range_m, ground=True)
        return ranges.reshape(lidar.n_rings, lidar.n_azimuths)

    def sees(self, origin: Array, points: Array) -> NDArray[np.bool_]:
        """Whether nothing stands between a point (3,) and each of others (K, 3)."""
        if len(points) == 0:
            return np.zeros(0, bool)
        distance = np.linalg.norm(points - origin, axis=1)
        share = self._bullet.cast(np.broadcast_to(origin, points.shape), points)
        seen: NDArray[np.bool_] = share * distance >= distance - _SURFACE_M
        return seen

    def _ranges(self, starts: Array, way: Array, reach_m: float, *, ground: bool) -> Array:
        share = self._bullet.cast(starts, starts + reach_m * way, ground=ground)
        return np.where(share < 1.0, share * reach_m, np.inf)


def sensor_pose(sensor: Laser | Lidar3D | StereoCamera, pose: Array) -> Array:
    """Pose (3,) of a mounted sensor in map for the robot's pose (3,)."""
    mount = sensor.mount
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    return np.array(
        [
            pose[0] + cos * mount.x_m - sin * mount.y_m,
            pose[1] + sin * mount.x_m + cos * mount.y_m,
            pose[2] + mount.yaw_rad,
        ]
    )


def points_in_camera(camera: StereoCamera, pose: Array, points_in_world: Array) -> Array:
    """Points (N, 3) of map in the camera frame (z forward, x right, y down), m."""
    planar = sensor_pose(camera, pose)
    offset = points_in_world - np.array([planar[0], planar[1], camera.mount.z_m])
    cos, sin = math.cos(planar[2]), math.sin(planar[2])
    forward = cos * offset[:, 0] + sin * offset[:, 1]
    left = -sin * offset[:, 0] + cos * offset[:, 1]
    return np.stack([-left, -offset[:, 2], forward], axis=-1)


class LandmarkEye:
    """The stereo camera's view of the world's landmarks."""

    def __init__(self, world: World, camera: StereoCamera, rng: np.random.Generator) -> None:
        self._world, self._camera, self._rng = world, camera, rng
        size = world.descriptors.shape[1] if world.descriptors.ndim == 2 else 0
        self._view_axes = rng.standard_normal((len(world.landmarks), size)).astype(np.float32)
        if size:
            self._view_axes /= np.linalg.norm(self._view_axes, axis=1, keepdims=True)
        self._first_view_rad = np.full(len(world.landmarks), np.nan)

    def observe(
        self, rays: ExactRays | BulletRays, pose: Array
    ) -> tuple[Array, NDArray[np.int64], NDArray[np.float32]]:
        """Points in the camera frame (K, 3), true ids (K,), descriptors (K, D)."""
        camera, landmarks = self._camera, self._world.landmarks
        inside = points_in_camera(camera, pose, landmarks)
        x, y, z = inside.T
        field_of_view = (
            (z > 0.05)
            & (np.abs(x) <= z * math.tan(camera.fov_horizontal_rad / 2))
            & (np.abs(y) <= z * math.tan(camera.fov_vertical_rad / 2))
            & (np.linalg.norm(inside, axis=1) <= camera.max_distance_m)
        )
        ids = np.flatnonzero(field_of_view)
        planar = sensor_pose(camera, pose)
        origin = np.array([planar[0], planar[1], camera.mount.z_m])
        ids = ids[rays.sees(origin, landmarks[ids])]
        ids = self._choose(ids, inside)
        observed = camera.measure(inside[ids], self._rng)
        descriptors = self._describe(ids, origin)
        whole = np.isfinite(observed).all(axis=1)
        return observed[whole], ids[whole].astype(np.int64), descriptors[whole]

    def _choose(self, ids: NDArray[np.int64], inside: Array) -> NDArray[np.int64]:
        """At most B of the visible landmarks, by the camera's rule."""
        camera = self._camera
        most = camera.max_observations
        if most == 0 or len(ids) <= most:
            return ids
        if camera.selection == "nearest":
            order = np.argsort(np.linalg.norm(inside[ids], axis=1), kind="stable")
            return ids[order[:most]]
        if camera.selection == "random":
            return self._rng.choice(ids, most, replace=False)
        # Farthest-point choice over the image: each next landmark is the one farthest, in
        # pixels, from those already taken.
        pixels = inside[ids, :2] / inside[ids, 2:]
        taken = [int(np.argmin(np.linalg.norm(pixels, axis=1)))]
        gap = np.linalg.norm(pixels - pixels[taken[0]], axis=1)
        while len(taken) < most:
            taken.append(int(np.argmax(gap)))
            gap = np.minimum(gap, np.linalg.norm(pixels - pixels[taken[-1]], axis=1))
        return ids[taken]

    def _describe(self, ids: NDArray[np.int64], origin: Array) -> NDArray[np.float32]:
        """Noisy descriptors: white noise, and a drift with the change of the viewing angle."""
        camera, world = self._camera, self._world
        if world.descriptors.size == 0:
            return np.zeros((len(ids), 0), np.float32)
        offset = world.landmarks[ids, :2] - origin[:2]
        view = np.arctan2(offset[:, 1], offset[:, 0])
        fresh = np.isnan(self._first_view_rad[ids])
        self._first_view_rad[ids[fresh]] = view[fresh]
        change = np.abs((view - self._first_view_rad[ids] + np.pi) % (2 * np.pi) - np.pi)
        size = world.descriptors.shape[1]
        white = self._rng.standard_normal((len(ids), size)) / math.sqrt(size)
        noisy = (
            world.descriptors[ids]
            + camera.sigma_descriptor * white
            + camera.sigma_view_descriptor * change[:, None] * self._view_axes[ids]
        )
        unit: NDArray[np.float32] = (noisy / np.linalg.norm(noisy, axis=1, keepdims=True)).astype(
            np.float32
        )
        return unit


class _SlipEvents:
    """Slip that kr and kl do not describe: a wheel's encoder runs on by some centimetres."""

    def __init__(self, robot: DifferentialDrive, rng: np.random.Generator) -> None:
        self._chance = robot.unmodelled_slip * DT_S
        self._step_m = robot.unmodelled_slip_m / _SLIP_EVENT_TICKS
        self._rng = rng.spawn(1)[0]
        self._left = np.zeros(2, dtype=np.int64)

    def error(self, rolling_m: Array) -> Array | float:
        """Encoder error (2,) m of this tick."""
        if self._chance == 0.0:
            return 0.0
        begins = self._rng.random(2) < self._chance
        self._left[begins] = _SLIP_EVENT_TICKS
        active = self._left > 0
        self._left[active] -= 1
        return np.where(active, self._step_m * np.sign(rolling_m), 0.0)


def _normals(rng: np.random.Generator, block: int = 3000) -> Iterator[Array]:
    """Pairs of standard normals, drawn in blocks for speed; the bits do not depend on the block."""
    while True:
        yield from rng.standard_normal((block, 2))


def _periods(sensors: SensorSuite) -> dict[str, int]:
    """Ticks between firings of each sensor."""
    periods = {}
    for name in ("encoder", "laser", "stereo", "lidar3d"):
        rate = getattr(getattr(sensors, name), "rate_hz", None)
        if rate is None:
            continue
        ticks = TICKS_PER_S / rate
        if abs(ticks - round(ticks)) > 1e-6 or round(ticks) < 1:
            raise InputError(
                f"sensors.{name}.rate_hz={rate:g} does not divide the simulation's "
                f"{TICKS_PER_S} Hz; choose one that does, such as 10, 20, 50, 75 or 100"
            )
        periods[name] = round(ticks)
    if not periods:
        raise InputError("no sensor fires; set sensors.encoder.rate_hz or add a sensor")
    return periods


def _assemble(
    world: World,
    robot: DifferentialDrive,
    sensors: SensorSuite,
    logs: _Logs,
    status: str,
    config: dict[str, Any],
) -> Recording:
    def read(name: str) -> tuple[Array, list[Any]]:
        ticks = np.array([tick for tick, _ in logs[name]], dtype=np.int64)
        return ticks / TICKS_PER_S, [reading for _, reading in logs[name]]

    stamps, frames = read("frames")
    encoder, travel, poses = (np.array(part) for part in zip(*frames, strict=True))
    poses[:, 2] = se2.wrap(poses[:, 2])
    command_stamps, commands = read("commands")
    laser = landmarks = clouds = None
    landmark_ids = np.zeros(0, np.int64)
    if sensors.laser:
        scan_stamps, scans = read("laser")
        laser = LaserLog(scan_stamps, np.array(scans))
    if sensors.lidar3d:
        turn_stamps, turns = read("lidar3d")
        clouds = CloudLog(turn_stamps, np.array(turns))
    if sensors.stereo:
        image_stamps, images = read("stereo")
        points, ids, descriptors = zip(*images, strict=True)
        landmark_ids = np.concatenate(ids)
        landmarks = LandmarkLog(
            stamps=image_stamps,
            splits=np.cumsum([0, *(len(p) for p in points)]),
            points_in_camera=np.concatenate(points),
            ids=landmark_ids if sensors.stereo.identifies else np.zeros(0, np.int64),
            descriptors=np.concatenate(descriptors),
        )
    return Recording(
        frame_stamps=stamps,
        wheels=WheelLog(stamps, encoder),
        robot=RobotGeometry(robot.wheel_radius_m, robot.track_m),
        sensors=sensors,
        truth=Truth(stamps, poses, travel, landmark_ids, world),
        laser=laser,
        landmarks=landmarks,
        clouds=clouds,
        commands=CommandLog(command_stamps, np.array(commands, float).reshape(-1, 2)),
        config=config,
        status=status,
    )
