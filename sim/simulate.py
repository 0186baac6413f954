"""World + robot + sensors + route + random streams -> Recording.

Time runs in ticks of 1/300 s. At each tick the wheels are driven, slip, and are read; each
sensor fires at its own multiple of the tick. The robots of a team advance together, tick by tick.
"""

import contextlib
import dataclasses
import itertools
import math
from collections import defaultdict
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import numpy as np

from sim import se2
from sim.arrays import Array, Values
from sim.errors import require
from sim.people.doors import Doors
from sim.people.giving_way import GivingWay
from sim.people.walk import Crowd, People
from sim.recording import CommandLog, Log, Recording, Truth, WheelLog, log_of_readings
from sim.robot.base import TICK_S, TICKS_PER_S, Robot
from sim.robot.collisions import Collisions, half_footprint_m, overlaps
from sim.robot.kinematic import KinematicBody
from sim.routes.feedback import Feedback, Onboard, feedback_of
from sim.sensors.base import Rays, Reading, Sensor, Sensors, View, split_schema
from sim.sensors.firing import Firing, periods, probes
from sim.sensors.rays import AmongFaces, AmongPeople, BulletRays, ExactRays, robot_faces
from sim.team import Team
from sim.worlds.world import World

Physics = Literal["bullet", "kinematic"]
RayKind = Literal["bullet", "exact"]
PassersBy = tuple[People, np.random.Generator]
_Logs = defaultdict[str, list[tuple[int, Any]]]  # by sensor: tick and reading

_CHECK_EVERY = 6  # ticks between looks for collisions


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

    def start(self, world: World, robot: Robot) -> tuple[Array, Driver]:
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

    robot: Robot
    sensors: Sensors
    route: Route
    streams: Mapping[str, np.random.Generator]
    config: dict[str, Any] = field(default_factory=dict)
    onboard: Onboard | None = None


def record(
    world: World,
    member: Member,
    *,
    physics: Physics = "bullet",
    rays: RayKind = "bullet",
    passers_by: PassersBy | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> Recording:
    """Drive the route of one robot and record what its sensors measure; see `record_team`."""
    return record_team(
        world, [member], physics=physics, rays=rays, passers_by=passers_by, on_progress=on_progress
    ).only


def record_team(
    world: World,
    members: Sequence[Member],
    *,
    physics: Physics = "bullet",
    rays: RayKind = "bullet",
    passers_by: PassersBy | None = None,
    on_progress: Callable[[float], None] | None = None,
) -> Team:
    """Drive the routes of several robots at once and record what their sensors measure.

    The robots see one another, and hide from one another what lies behind their bodies. They do not
    collide. One that has ended its route stands there until all have.

    Parameters
    ----------
    physics
        `bullet`: rigid-body dynamics. `kinematic`: the same slip law with ideal rolling.
    rays
        `bullet`, or `exact` for the caster of `sim.sensors.casting`; the geometry is the same.
    passers_by
        Who walks there, and their random stream. Robots wait for people, and people walk round
        robots.
    on_progress
        Called about every simulated second with the simulated time, s.

    Returns
    -------
    Team
        The status of each recording is `ok`, or names what went wrong and when; it then ends there.

    Raises
    ------
    InputError
        If a sensor's rate does not divide 300 Hz, if a robot overlaps a wall or another one at its
        start, or if Bullet rays are asked for without Bullet physics.
    """
    require(
        rays != "bullet" or physics == "bullet", "rays=bullet needs physics=bullet; set rays=exact"
    )
    require(
        rays != "bullet" or world.materials is None,
        f"world {world.name} has walls of glass or dark ones; set rays=exact",
    )
    for member in members:
        periods(member.sensors)  # checks them before anything is built
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
    crowd = _crowd_of(world, members, [pose for pose, _ in starts], passers_by)
    doors = None
    if passers_by is not None and world.doors is not None:
        (own,) = passers_by[1].spawn(1)
        doors = Doors(world.doors, np.array([pose for pose, _ in starts]), own)
    statuses: dict[int, str] = {}
    drives: dict[int, _Drive] = {}
    with contextlib.ExitStack() as stack:
        for number, member in enumerate(members):
            start, driver = starts[number]
            feedback = feedback_of(
                member.route, member.robot, start, member.sensors, world, member.onboard
            )
            body, find_trouble, caster = _bodied(world, member.robot, start, physics, rays, stack)
            others = _others(now, number)
            if len(members) > 1:
                caster = AmongFaces(caster, _bodies_of(members, others))
            if doors is not None:
                caster = AmongFaces(caster, doors.faces)
            if crowd is not None:
                caster = AmongPeople(caster, crowd)
                driver = GivingWay(driver, crowd, number, member.robot, _pose_of(body))
            first = View(0.0, start, world, caster, 0.0, start, others())
            firing = probes(member.sensors, member.streams["sensors"], first, others)
            drives[number] = _Drive(member, body, driver, feedback, find_trouble, firing)
        underway = {number: drive.run() for number, drive in drives.items()}
        for tick in itertools.count():
            if len(members) > 1:
                now.update(enumerate(drive.body.pose for drive in drives.values()))
            if crowd is not None or doors is not None:
                _let_move(crowd, doors, tick, [drive.body.pose for drive in drives.values()])
            for number, drive in [*underway.items()]:
                try:
                    next(drive)
                except StopIteration as end:
                    statuses[number] = end.value
                    del underway[number]
            if not underway:
                break
            if on_progress is not None and tick % TICKS_PER_S == 0:
                on_progress(tick * TICK_S)
    return Team.on_one_clock(
        [
            _assemble(world, member, drives[number].logs, statuses[number], crowd)
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
    radii_m = [float(half_footprint_m(member.robot).min()) for member in members]
    for one, other in itertools.combinations(range(len(members)), 2):
        apart_m = math.hypot(*(poses[one] - poses[other])[:2])
        require(
            apart_m >= radii_m[one] + radii_m[other],
            f"robots {one} and {other} start within each other, {apart_m:.2f} m apart; give one "
            "another start by its route in team.robots",
        )


def _crowd_of(
    world: World, members: Sequence[Member], poses: Sequence[Array], passers_by: PassersBy | None
) -> Crowd | None:
    """The people at work, if there are any."""
    if passers_by is None or passers_by[0].n == 0:
        return None
    return Crowd(passers_by[0], world, [member.robot for member in members], poses, passers_by[1])


def _let_move(crowd: Crowd | None, doors: Doors | None, tick: int, poses: Sequence[Array]) -> None:
    """Let people and doors move at a tick, with the robots at poses (3,)."""
    if crowd is not None:
        crowd.advance(tick, poses)
    if doors is not None:
        walking = np.zeros((0, 3)) if crowd is None else crowd.at(np.array(crowd.now_s))[:, :3]
        doors.advance(tick, np.vstack([poses, walking]))


def _pose_of(body: Body) -> Callable[[], Array]:
    """Function that gives a body's pose (3,) as it is now."""
    return lambda: body.pose


def _bodied(
    world: World,
    robot: Robot,
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
    return body, Collisions(world, robot, lambda: body.pose), ExactRays(world)


def _others(now: Mapping[int, Array], number: int) -> Callable[[], Mapping[int, Array]]:
    """Function that gives the poses of the other robots at this tick."""
    return lambda: {other: pose for other, pose in now.items() if other != number}


def _bodies_of(
    members: Sequence[Member], others: Callable[[], Mapping[int, Array]]
) -> Callable[[], tuple[Array, Array]]:
    """Function that gives the faces of the other robots at this tick, and their heights."""
    return lambda: robot_faces([(members[other].robot, pose) for other, pose in others().items()])


class _Drive:
    """The simulation loop of one robot."""

    def __init__(
        self,
        member: Member,
        body: Body,
        driver: Driver,
        feedback: Feedback,
        find_trouble: Callable[[], str | None],
        firing: Mapping[str, Firing],
    ) -> None:
        self.body, self.logs = body, _Logs(list)
        self._member, self._driver, self._feedback = member, driver, feedback
        self._find_trouble, self._firing = find_trouble, firing

    def run(self) -> Generator[None, None, str]:
        """Run a tick at each `next`, until the route ends or something goes wrong; the status."""
        robot, driver, feedback = self._member.robot, self._driver, self._feedback
        body, logs, fire_every = self.body, self.logs, periods(self._member.sensors)
        slip = robot.start_slip(TICK_S, self._member.streams["slip"])
        encoder, travel = np.zeros(2), np.zeros(2)
        sweeps = [firing for firing in self._firing.values() if firing.sweeps]
        tick, velocity, speeds = 0, (0.0, 0.0), (0.0, 0.0)
        while True:
            pose = body.pose
            pose.setflags(write=False)
            for sweeping in sweeps:
                sweeping.follow(tick / TICKS_PER_S, pose)
            due = [name for name, period in fire_every.items() if tick % period == 0]
            wanted = driver.command(tick, feedback.pose(tick, pose, encoder))
            if due or wanted is None:
                logs["/frames"].append(
                    (tick, (robot.encoder_reading(encoder), travel.copy(), pose))
                )
            if due:
                readings = {name: self._firing[name](tick / TICKS_PER_S, pose) for name in due}
                shown = {name: reading for name, reading in readings.items() if reading is not None}
                for name, reading in shown.items():
                    logs[name].append((tick, reading))
                feedback.see(tick / TICKS_PER_S, encoder, shown)
                if hasattr(driver, "see"):
                    driver.see(feedback.pose(tick, pose, encoder), shown)
            if wanted is None or tick % _CHECK_EVERY == 0:
                trouble = (self._find_trouble() if wanted is not None else None) or driver.trouble
                if trouble is not None:
                    return f"{trouble} at {tick * TICK_S:.2f} s near ({pose[0]:.2f}, {pose[1]:.2f})"
            if wanted is None:
                return "ok"
            if (*wanted,) != velocity or tick == 0:
                velocity = (*wanted,)
                speeds = (*robot.wheel_speeds(*velocity).tolist(),)
                logs["/commands"].append((tick, velocity))
            right_mps, left_mps = slip.correction_mps
            rolled = body.step(speeds[0] - right_mps, speeds[1] - left_mps)
            right_m, left_m = slip.advance(rolled)
            encoder[0] += right_m
            encoder[1] += left_m
            travel += rolled
            tick += 1
            yield


def _assemble(
    world: World, member: Member, logs: _Logs, status: str, crowd: Crowd | None
) -> Recording:
    def read(name: str) -> tuple[Array, list[Any]]:
        ticks = np.array([tick for tick, _ in logs[name]], dtype=np.int64)
        return ticks / TICKS_PER_S, [reading for _, reading in logs[name]]

    stamps, frames = read("/frames")
    encoder, travel, poses = (np.array(part) for part in zip(*frames, strict=True))
    poses[:, 2] = se2.wrap(poses[:, 2])
    command_stamps, commands = read("/commands")
    people = None if crowd is None else crowd.tracks(stamps)
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
        truth=Truth(stamps, poses, travel, {k: v for k, v in hidden.items() if v}, world, people),
        commands=CommandLog(command_stamps, np.array(commands, float).reshape(-1, 2)),
        config=member.config,
        status=status,
    )


def _log(
    name: str, sensor: Sensor, stamps: Array, readings: list[Reading]
) -> tuple[Log, dict[str, Values]]:
    """Log of a sensor, and what its schema marks as truth."""
    schema = sensor.schema
    log = log_of_readings(schema, stamps, readings, f"sensors.{name}")
    seen, hidden = split_schema(schema)
    return (
        dataclasses.replace(log, schema=seen, values={key: log[key] for key in seen}),
        {key: log[key] for key in hidden},
    )
