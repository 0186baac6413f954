"""World + robot + sensors + route + random streams -> Recording.

Time runs in ticks of 1/300 s. At each tick the wheels are driven, slip, and are read; each
sensor fires at its own multiple of the tick. The robots of a team advance together, tick by tick.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import math
import zlib
from collections import defaultdict
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from sim import se2
from sim.arrays import Array
from sim.errors import InputError, blaming, require
from sim.recording import CommandLog, Log, Recording, Truth, WheelLog, joined
from sim.robot.drive import DifferentialDrive, scaled_error
from sim.robot.kinematic import KinematicBody
from sim.routes.feedback import Feedback, Onboard, feedback_of
from sim.sensors.base import Rays, Reading, Sensor, Sensors, View, parted
from sim.sensors.rays import AmongRobots, BulletRays, ExactRays
from sim.team import Team
from sim.worlds.world import World

Physics = Literal["bullet", "kinematic"]
RayKind = Literal["bullet", "exact"]
_Logs = defaultdict[str, list[tuple[int, Any]]]  # by sensor: tick and reading

TICKS_PER_S = 300
DT_S = 1.0 / TICKS_PER_S
_CHECK_EVERY = 6  # ticks between looks for collisions
_SLIP_EVENT_TICKS = 30
# These draw their noise from one generator, in this order; every other sensor has its own
_SHARE_NOISE = ("laser", "stereo", "lidar3d")


class Body(Protocol):
    """What moves: PyBullet's robot or the kinematic one."""

    def step(self, right_mps: float, left_mps: float) -> tuple[float, float]:
        """Advance one tick at these wheel speeds; return the wheels' rolling, m."""

    @property
    def pose(self) -> Array:
        """(3,) m, m, rad."""


class Driver(Protocol):
    """What commands a run, tick by tick.

    It may also have `begin(sensors, drivers)`, called once with what the robot carries and the
    drivers of all robots of its team, and `see(pose, readings)`, called after each Frame with the
    pose (3,) that is believed then.
    """

    def command(self, tick: int, pose: Array) -> Array | None:
        """Body velocity (2,) m/s, rad/s for the tick, or None when the route is done.

        The pose (3,) is the one that the route's feedback gives, the true one or a believed one.
        """

    @property
    def trouble(self) -> str | None:
        """`off_route` or `incomplete` if the route was not kept, else None."""


class Route(Protocol):
    """A plan that gives a Driver for a robot in a world.

    It may have an attribute `feedback`, see `sim.routes.feedback`; without one its driver gets the
    truth. It may have `about_s(world, robot)`, about how long the drive takes, s.
    """

    def start(self, world: World, robot: DifferentialDrive) -> tuple[Array, Driver]:
        """Start pose (3,) and the driver."""


@dataclass(frozen=True)
class Member:
    """One robot of a team, with what it carries and where it is sent.

    Attributes
    ----------
    streams
        Generators `slip` and `sensors`.
    config
        Kept in its recording: where it came from.
    onboard
        Starts the estimator that a route's feedback names.
    """

    robot: DifferentialDrive
    sensors: Sensors
    route: Route
    streams: Mapping[str, np.random.Generator]
    config: dict[str, Any] = field(default_factory=dict)
    onboard: Onboard | None = None


def record(
    world: World,
    robot: DifferentialDrive,
    sensors: Sensors,
    route: Route,
    streams: Mapping[str, np.random.Generator],
    *,
    physics: Physics = "bullet",
    rays: RayKind = "bullet",
    config: dict[str, Any] | None = None,
    on_progress: Callable[[float], None] | None = None,
    onboard: Onboard | None = None,
) -> Recording:
    """Drive the route and record what the sensors measure.

    Parameters
    ----------
    streams
        Generators `slip` and `sensors`.
    physics
        `bullet`: rigid-body dynamics. `kinematic`: the same slip law with ideal rolling.
    rays
        `bullet`, or `exact` for the caster of `sim.sensors.casting`; the geometry is the same.
    config
        Kept in the recording: where it came from.
    on_progress
        Called about every simulated second with the simulated time, s.
    onboard
        Starts the estimator that a route's feedback names.

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
    member = Member(robot, sensors, route, streams, config or {}, onboard)
    options: Any = {"physics": physics, "rays": rays, "on_progress": on_progress}
    return record_team(world, [member], **options).robots[0]


def record_team(
    world: World,
    members: Sequence[Member],
    *,
    physics: Physics = "bullet",
    rays: RayKind = "bullet",
    on_progress: Callable[[float], None] | None = None,
) -> Team:
    """Drive the routes of several robots at once and record what their sensors measure.

    The robots see one another, and hide from one another what lies behind their bodies. They do not
    collide. One that has ended its route stands there until all have.

    Parameters and errors are those of `record`; a robot's own are in its `Member`.
    """
    require(
        rays != "bullet" or physics == "bullet", "rays=bullet needs physics=bullet; set rays=exact"
    )
    periods = [_periods(member.sensors) for member in members]
    starts = [member.route.start(world, member.robot) for member in members]
    _check_starts(world, members, [pose for pose, _ in starts])
    for member, (_, driver) in zip(members, starts, strict=True):
        if hasattr(driver, "begin"):
            driver.begin(member.sensors, [other for _, other in starts])
    # a sensor looks at them, and must not change them
    for values in (*(pose for pose, _ in starts), *vars(world).values()):
        if isinstance(values, np.ndarray):
            values.setflags(write=False)
    now = dict(enumerate(pose for pose, _ in starts))  # poses at the tick
    logs: list[_Logs] = [defaultdict(list) for _ in members]
    statuses: dict[int, str] = {}
    with contextlib.ExitStack() as stack:
        bodies, drives = [], {}
        for number, member in enumerate(members):
            start, driver = starts[number]
            onboard, robot = member.onboard, member.robot
            feedback = feedback_of(member.route, robot, start, member.sensors, world, onboard)
            body, find_trouble, caster = _bodied(world, robot, start, physics, rays, stack)
            probes = _probes(
                world, member, _seeing(caster, members, now, number), start, _others(now, number)
            )
            slip, own = member.streams["slip"], periods[number]
            drives[number] = _drive(
                robot, own, body, driver, feedback, find_trouble, probes, slip, logs[number]
            )
            bodies.append(body)
        for tick in itertools.count():
            if len(members) > 1:
                now.update(enumerate(body.pose for body in bodies))
            for number, drive in [*drives.items()]:
                try:
                    next(drive)
                except StopIteration as end:
                    statuses[number] = end.value
                    del drives[number]
            if not drives:
                break
            if on_progress is not None and tick % TICKS_PER_S == 0:
                on_progress(tick * DT_S)
    return Team.on_one_clock(
        [
            _assemble(world, member, logs[number], statuses[number])
            for number, member in enumerate(members)
        ]
    )


def _check_starts(world: World, members: Sequence[Member], poses: Sequence[Array]) -> None:
    """Check that no robot starts in a wall or in another robot."""
    for number, (member, pose) in enumerate(zip(members, poses, strict=True)):
        whose = f"robot {number}" if len(members) > 1 else "the robot"
        require(
            not overlaps(world, member.robot, pose),
            f"{whose} overlaps a wall of world {world.name} at its start "
            f"({pose[0]:.2f}, {pose[1]:.2f}); move the start pose or the wall",
        )
    radii_m = [float(_half_footprint_m(member.robot).min()) for member in members]
    for one, other in itertools.combinations(range(len(members)), 2):
        apart_m = math.hypot(*(poses[one] - poses[other])[:2])
        require(
            apart_m >= radii_m[one] + radii_m[other],
            f"robots {one} and {other} start within each other, {apart_m:.2f} m apart; give one "
            "another start by its route in team.robots",
        )


def _bodied(
    world: World,
    robot: DifferentialDrive,
    start: Array,
    physics: Physics,
    rays: RayKind,
    stack: contextlib.ExitStack,
) -> tuple[Body, Callable[[], str | None], Rays]:
    """Body of a robot, what looks for its troubles, and rays in its world."""
    if physics == "bullet":
        from sim.robot.bullet import BulletBody

        bullet = stack.enter_context(BulletBody(world, robot, start))
        caster = BulletRays(bullet) if rays == "bullet" else ExactRays(world)
        return bullet, lambda: bullet.trouble, caster
    body = KinematicBody(robot, start)
    return body, _Collisions(world, robot, body), ExactRays(world)


def _others(now: Mapping[int, Array], number: int) -> Callable[[], Mapping[int, Array]]:
    """Function that gives the poses of the other robots at this tick."""
    return lambda: {other: pose for other, pose in now.items() if other != number}


def _seeing(rays: Rays, members: Sequence[Member], now: Mapping[int, Array], number: int) -> Rays:
    """Rays of one robot of a team."""
    if len(members) == 1:
        return rays
    others = _others(now, number)
    return AmongRobots(
        rays, lambda: [(members[other].robot, pose) for other, pose in others().items()]
    )


def _probes(
    world: World,
    member: Member,
    rays: Rays,
    start: Array,
    others: Callable[[], Mapping[int, Array]],
) -> dict[str, _Firing]:
    """Every sensor at work, those that share their noise first."""
    sensors, rng = member.sensors, member.streams["sensors"]
    order = [*(name for name in _SHARE_NOISE if name in sensors)]
    order += [name for name in sensors if name not in order]
    probes = {}
    for name in order:
        own = rng if name in _SHARE_NOISE else _stream_of(rng, name)
        first = View(0.0, start, world, rays, 0.0, start, others())
        probes[name] = _Firing(name, sensors[name], own, first, others)
    return probes


def _stream_of(rng: np.random.Generator, name: str) -> np.random.Generator:
    """Generator of a sensor's own: what other sensors there are does not change its noise."""
    seed: Any = rng.bit_generator.seed_seq
    key = (*seed.spawn_key, zlib.crc32(name.encode()))
    return np.random.default_rng(np.random.SeedSequence(seed.entropy, spawn_key=key))


class _Firing:
    """A sensor at work, and what it saw last."""

    def __init__(
        self,
        name: str,
        sensor: Sensor,
        rng: np.random.Generator,
        first: View,
        others: Callable[[], Mapping[int, Array]],
    ) -> None:
        self._where, self._schema, self._last = f"sensors.{name}", sensor.schema, first
        self._others = others
        with blaming(self._where):
            self._probe = sensor.start(rng)
            if hasattr(self._probe, "begin"):
                self._probe.begin(first)
        require(callable(self._probe), f"{self._where}: start must return a function of the view")

    def __call__(self, stamp: float, pose: Array) -> Reading | None:
        last, others = self._last, self._others()
        self._last = View(stamp, pose, last.world, last.rays, last.stamp, last.pose, others)
        with blaming(self._where):
            reading = self._probe(self._last)
        if reading is None:
            return None
        if not (isinstance(reading, Mapping) and set(reading) == set(self._schema)):
            raise InputError(  # the text of an array takes longer than the reading
                f"{self._where}: a reading must have the fields {[*self._schema]}, "
                f"got {reading!r:.60}"
            )
        return {
            key: field.taken(reading[key], f"{self._where}.{key}")
            for key, field in self._schema.items()
        }


def _drive(
    robot: DifferentialDrive,
    periods: dict[str, int],
    body: Body,
    driver: Driver,
    feedback: Feedback,
    find_trouble: Callable[[], str | None],
    probes: dict[str, _Firing],
    rng: np.random.Generator,
    logs: _Logs,
) -> Generator[None, None, str]:
    """Run a tick at each `next`, until the route ends or something goes wrong; the status."""
    right, left = robot.slips(DT_S)
    noise = _normals(rng)
    events, together = _SlipEvents(robot, rng), _ForwardSlip(robot, rng)
    encoder, travel = np.zeros(2), np.zeros(2)
    tick, velocity, speeds = 0, (0.0, 0.0), (0.0, 0.0)
    while True:
        pose = body.pose
        pose.setflags(write=False)
        due = [name for name, period in periods.items() if tick % period == 0]
        wanted = driver.command(tick, feedback.pose(tick, pose, encoder))
        if due or wanted is None:
            logs["/frames"].append((tick, (robot.encoder_reading(encoder), travel.copy(), pose)))
        if due:
            readings = {name: probes[name](tick / TICKS_PER_S, pose) for name in due}
            shown = {name: reading for name, reading in readings.items() if reading is not None}
            for name, reading in shown.items():
                logs[name].append((tick, reading))
            feedback.see(tick / TICKS_PER_S, encoder, shown)
            if hasattr(driver, "see"):
                driver.see(feedback.pose(tick, pose, encoder), shown)
        if wanted is None or tick % _CHECK_EVERY == 0:
            trouble = (find_trouble() if wanted is not None else None) or driver.trouble
            if trouble is not None:
                return f"{trouble} at {tick * DT_S:.2f} s near ({pose[0]:.2f}, {pose[1]:.2f})"
        if wanted is None:
            return "ok"
        if (*wanted,) != velocity or tick == 0:
            velocity = (*wanted,)
            speeds = (*robot.wheel_speeds(*velocity).tolist(),)
            logs["/commands"].append((tick, velocity))
        rolled = body.step(speeds[0] - right.correction_mps, speeds[1] - left.correction_mps)
        z_right, z_left = next(noise)
        extra_right, extra_left = events.error(rolled)
        both = together.error(rolled)
        encoder[0] += right.advance(rolled[0], z_right, extra_right + both)
        encoder[1] += left.advance(rolled[1], z_left, extra_left + both)
        travel += rolled
        tick += 1
        yield


def overlaps(world: World, robot: DifferentialDrive, pose: Array) -> bool:
    """Whether a wall that stands in the robot's height crosses its footprint (body and wheels)."""
    low = world.wall_z_m[:, 0] < robot.body_height_m
    if not np.any(low):
        return False
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    to_base = np.array([[cos, sin], [-sin, cos]])
    start = (world.walls[low, :2] - pose[:2]) @ to_base.T
    along = (world.walls[low, 2:] - pose[:2]) @ to_base.T - start
    half = _half_footprint_m(robot)
    # Clip each wall against the footprint's two slabs; what is left of it lies inside.
    with np.errstate(divide="ignore", invalid="ignore"):
        near, far = (-half - start) / along, (half - start) / along
    parallel = np.abs(along) < 1e-12
    outside = parallel & (np.abs(start) > half)
    enter = np.where(parallel, -np.inf, np.minimum(near, far)).max(axis=1)
    leave = np.where(parallel, np.inf, np.maximum(near, far)).min(axis=1)
    hit = (np.maximum(enter, 0.0) <= np.minimum(leave, 1.0)) & ~outside.any(axis=1)
    return bool(np.any(hit))


class _Collisions:
    """Looks for collisions of a body without an engine, and only where a wall is within reach."""

    def __init__(self, world: World, robot: DifferentialDrive, body: Body) -> None:
        self._world, self._robot, self._body = world, robot, body
        self._reach_m = math.hypot(*_half_footprint_m(robot))
        self._at, self._free_m = np.zeros(2), -1.0  # no wall is nearer to that point

    def __call__(self) -> str | None:
        """`collision` if the robot overlaps a wall now, else None."""
        pose = self._body.pose
        if math.hypot(*(pose[:2] - self._at)) + self._reach_m < self._free_m:
            return None
        self._at, self._free_m = pose[:2], self._world.clearance_m(pose[:2])
        return "collision" if overlaps(self._world, self._robot, pose) else None


def _half_footprint_m(robot: DifferentialDrive) -> Array:
    """Half the length and width (2,) of body and wheels, m."""
    return np.array(
        [
            max(robot.body_length_m / 2, robot.wheel_radius_m),
            max(robot.body_width_m, robot.track_m) / 2,
        ]
    )


class _SlipEvents:
    """Slip that kr and kl do not describe: a wheel's encoder runs on by some centimetres."""

    def __init__(self, robot: DifferentialDrive, rng: np.random.Generator) -> None:
        self._chance = robot.unmodelled_slip * DT_S
        self._step_m = robot.unmodelled_slip_m / _SLIP_EVENT_TICKS
        self._rng = rng.spawn(1)[0]
        self._left = np.zeros(2, dtype=np.int64)

    def error(self, rolling_m: tuple[float, float]) -> tuple[float, float]:
        """Encoder errors of the right and left wheel, m, of this tick."""
        if self._chance == 0.0:
            return 0.0, 0.0
        self._left[self._rng.random(2) < self._chance] = _SLIP_EVENT_TICKS
        active = self._left > 0
        self._left[active] -= 1
        right, left = np.where(active, self._step_m * np.sign(rolling_m), 0.0).tolist()
        return right, left


class _ForwardSlip:
    """Slip that both wheels share: white over the way, or a share of the travel that lasts.

    That share is an Ornstein-Uhlenbeck process of length l over the travel s, with the variance
    q / 2l. So its error over s has the variance q (s - l (1 - exp(-s / l))): q per metre in the
    long run.
    """

    def __init__(self, robot: DifferentialDrive, rng: np.random.Generator) -> None:
        self._variance_per_m, self._length_m = robot.forward_slip_m, robot.forward_slip_length_m
        self._normals = _normals(rng.spawn(1)[0])
        if self._length_m:
            self._spread = math.sqrt(self._variance_per_m / (2.0 * self._length_m))
            self._share = self._spread * next(self._normals)[0]

    def error(self, rolling_m: tuple[float, float]) -> float:
        """Error of both encoders, m, of this tick."""
        if self._variance_per_m == 0.0:
            return 0.0
        travel_m = (abs(rolling_m[0]) + abs(rolling_m[1])) / 2.0
        if self._length_m:
            kept = math.exp(-travel_m / self._length_m)
            news = self._spread * math.sqrt(1.0 - kept * kept) * next(self._normals)[0]
            self._share = kept * self._share + news
            return self._share * travel_m
        return float(scaled_error(travel_m, self._variance_per_m, next(self._normals)[0]))


def _normals(rng: np.random.Generator, block: int = 3000) -> Iterator[tuple[float, float]]:
    """Pairs of standard normals, drawn in blocks for speed; the bits do not depend on the block."""
    while True:
        yield from rng.standard_normal((block, 2)).tolist()


def _periods(sensors: Sensors) -> dict[str, int]:
    """Ticks between firings of each sensor."""
    periods = {}
    order = [name for name in _SHARE_NOISE if name in sensors]
    for name in (*order, *(name for name in sensors if name not in order)):
        rate = sensors[name].rate_hz
        if rate is None:
            continue
        number = isinstance(rate, (int, float)) and 0.0 < rate < math.inf
        require(number, f"sensors.{name}.rate_hz must be a positive number or null, got {rate!r}")
        ticks = TICKS_PER_S / rate
        require(
            abs(ticks - round(ticks)) <= 1e-6 and round(ticks) >= 1,
            f"sensors.{name}.rate_hz={rate:g} does not divide the simulation's "
            f"{TICKS_PER_S} Hz; choose one that does, such as 10, 20, 50, 75 or 100",
        )
        periods[name] = round(ticks)
    require(periods, "no sensor fires; set sensors.encoder.rate_hz or add a sensor")
    return periods


def _assemble(world: World, member: Member, logs: _Logs, status: str) -> Recording:
    def read(name: str) -> tuple[Array, list[Any]]:
        ticks = np.array([tick for tick, _ in logs[name]], dtype=np.int64)
        return ticks / TICKS_PER_S, [reading for _, reading in logs[name]]

    stamps, frames = read("/frames")
    encoder, travel, poses = (np.array(part) for part in zip(*frames, strict=True))
    poses[:, 2] = se2.wrap(poses[:, 2])
    command_stamps, commands = read("/commands")
    made, hidden = {}, {}
    for name, sensor in member.sensors.items():
        if sensor.schema:
            made[name], hidden[name] = _log(name, sensor, *read(name))
    return Recording(
        frame_stamps=stamps,
        wheels=WheelLog(stamps, encoder),
        robot=member.robot.nominal,
        sensors=member.sensors,
        logs=made,
        truth=Truth(stamps, poses, travel, {k: v for k, v in hidden.items() if v}, world),
        commands=CommandLog(command_stamps, np.array(commands, float).reshape(-1, 2)),
        config=member.config,
        status=status,
    )


def _log(
    name: str, sensor: Sensor, stamps: Array, readings: list[Reading]
) -> tuple[Log, dict[str, NDArray[Any]]]:
    """Log of a sensor, and what its schema marks as truth."""
    schema = sensor.schema
    log = joined(schema, stamps, readings, f"sensors.{name}")
    seen, hidden = parted(schema)
    return (
        dataclasses.replace(log, schema=seen, values={key: log[key] for key in seen}),
        {key: log[key] for key in hidden},
    )
