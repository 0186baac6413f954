"""Where the robot is sent: open-loop commands and way-point following.

A velocity command is (v, omega): m/s forward and rad/s counter-clockwise.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from pydantic import Field, Strict

from sim.arrays import Array, ArrayLike
from sim.errors import require
from sim.options import NonNegative, Points, Positive, options
from sim.robot.arc import arc_increment
from sim.robot.base import TICK_S, Robot
from sim.routes.feedback import CONTROL_TICKS, check_feedback
from sim.se2 import chain, transform
from sim.worlds.world import World, facing_second

MOST_S = 1e5  # that a route by the clock lasts: each tick is an array's row
DriveLength = Annotated[float, Field(gt=0.0, le=1e5)]  # m

Segment = tuple[float, float, float]
Segments = Annotated[
    tuple[Annotated[Segment, Strict(False)], ...],
    Strict(False),
    "a list of [v, omega, duration]",
]


@options("route")
class OpenLoop:
    """Commands given by the clock, blind to where the robot is (puzzlebot2024, table 1).

    A segment (v, omega, T) promises the distance v T and the angle omega T, and keeps that
    promise exactly: both velocities ramp up together from the segment's start and down
    from its end, so the path is the arc of curvature omega / v all along, and what the first
    ramp loses the second one gives back. The faster wheel ramps at the robot's acceleration. A
    segment too short to reach its velocity becomes a triangle of the same area. The robot rests
    between two segments, unless their velocities are the same.

    """

    segments: Segments
    """[v m/s, omega rad/s, duration s] each; both velocities zero for a pause."""
    rest_s: NonNegative = 0.2
    """Rest after the last segment, s."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "segments", tuple(_merged(self.segments)))
        require(self.segments, "route.segments is empty; give at least one [v, omega, duration]")

    def start(self, world: World, robot: Robot) -> tuple[Array, Replay]:
        """Start pose (3,) of the world, and the driver."""
        return world.start_pose, Replay(self.profile(robot))

    def about_s(self, world: World, robot: Robot) -> float:
        """How long the drive takes, s."""
        return float(self.edges_s(robot)[-1]) + self.rest_s

    def profile(self, robot: Robot, dt_s: float = TICK_S) -> Array:
        """Body velocities (N, 2), m/s and rad/s: means over ticks of `dt_s`, rest included.

        Being means, they add up to the promised distance and angle exactly.
        """
        *starts_s, end_s = self.edges_s(robot)
        total_s = end_s + self.rest_s
        require(
            total_s <= MOST_S,
            f"route.segments and route.rest_s last {total_s:g} s; {MOST_S:g} s are the most",
        )
        n_ticks = math.ceil(total_s / dt_s - 1e-9)
        edges_s = dt_s * np.arange(n_ticks + 1, dtype=np.float64)
        velocity = np.zeros((n_ticks, 2))
        for start_s, segment in zip(starts_s, self.segments, strict=True):
            first = int(start_s / dt_s)
            held_s = _held(edges_s[first:] - start_s, segment, robot)
            velocity[first:] += np.diff(held_s)[:, None] / dt_s * np.array(segment[:2])
        return velocity

    def edges_s(self, robot: Robot) -> Array:
        """Times (S + 1,) at which the segments begin and the last one ends, s."""
        ramps = [_trapezoid(segment, robot) for segment in self.segments]
        lasts_s = [plateau_s + 2.0 * ramp_s for plateau_s, ramp_s, _ in ramps]
        return np.concatenate([[0.0], np.cumsum(lasts_s)])

    def ideal_end(self, start: ArrayLike = (0.0, 0.0, 0.0)) -> Array:
        """Pose (3,) that the commands promise at the end; heading unwrapped."""
        v, omega, duration_s = np.array(self.segments).T
        travel = np.stack([v + omega, v - omega], axis=1) * duration_s[:, None]
        return np.asarray(chain(arc_increment(travel, 2.0), start)[-1])


@dataclass(frozen=True)
class Replay:
    """Driver that plays velocities (N, 2) tick by tick."""

    velocity: Array

    def command(self, tick: int, pose: Array) -> Array | None:
        """Velocity (2,) of the tick; None at the end. The pose is not looked at."""
        return self.velocity[tick] if tick < len(self.velocity) else None

    @property
    def trouble(self) -> None:
        """A clock cannot leave its route."""
        return None


@options("route")
class SteeredOptions:
    """What routes have in common that a controller steers along by a pose."""

    speed_mps: Positive = 0.5
    """Cruising speed."""
    turn_rate_radps: Positive = 1.0
    """Limit of the turn rate."""
    feedback: str | Mapping[str, Any] = "truth"
    """The pose that is followed: `truth`, `odometry`, or a mapping with the `_target_` of an
    estimator; see `sim.routes.feedback`."""

    def __post_init__(self) -> None:
        check_feedback(self.feedback)


@options("route")
class PursuitOptions(SteeredOptions):
    """What routes have in common that are followed by pure pursuit."""

    look_ahead_m: Positive = 0.35
    """Distance of the point pursued."""


@options("route")
class Tour(PursuitOptions):
    """Way-point following by pure pursuit.

    Guided by its true pose, as if someone drove it, the robot keeps its route, and slip makes only
    the odometry err. Guided by its odometry, it leaves the route without noticing.
    """

    waypoints: Points | None = None
    """[[x, y], ...], at least two; null for the world's own tour."""
    distance_m: DriveLength | None = None
    """Where to end, counted along the tour; null for all of it. A longer distance than the tour
    has goes round again if the tour is closed, else back and forth."""
    tolerance_m: Positive = 0.5
    """Distance from the tour at which the robot counts as off its route."""

    def __post_init__(self) -> None:
        super().__post_init__()
        enough = self.waypoints is None or len(self.waypoints) >= 2
        require(enough, "route.waypoints must be null or at least two points [x, y], m")

    def start(self, world: World, robot: Robot) -> tuple[Array, Pursuit]:
        """Start pose (3,) on the first way-point, facing the second, and the driver."""
        path = _lengthened(self._given(world), self.distance_m)
        return facing_second(path), Pursuit(self, robot, path)

    def about_s(self, world: World, robot: Robot) -> float:
        """About how long the drive takes, s; at 0.5 m/s a radian of its turns costs some 0.6 s."""
        path = _lengthened(self._given(world), self.distance_m)
        x, y = np.diff(path, axis=0).T
        turns = np.diff(np.unwrap(np.arctan2(y, x)))
        speeding_s = 2.0 * self.speed_mps / robot.max_acceleration_mps2
        turning_s = 0.6 * float(np.abs(turns).sum())
        return round(float(_along_m(path)[-1]) / self.speed_mps + speeding_s + turning_s)

    def _given(self, world: World) -> Array:
        """Way-points (P, 2) to follow."""
        given = world.waypoints if self.waypoints is None else np.array(self.waypoints, float)
        require(
            given.ndim == 2 and given.shape[1] == 2 and len(given) >= 2,
            f"route: world {world.name} has no tour of at least two way-points; give "
            "route.waypoints=[[x, y], ...]",
        )
        require(
            _along_m(given)[-1] > 1e-6, "route: its way-points are all one place; give two apart"
        )
        return given


@options("route")
class TourFrom(Tour):
    """A Tour that goes round, from any of its way-points on: of a team, each robot has its own."""

    first: int = 0
    """Way-point to begin at. A tour that does not end where it begins is closed by a way back."""
    backwards: bool = False
    """Whether it is driven against its direction."""

    def _given(self, world: World) -> Array:
        path = super()._given(world)
        if np.hypot(*(path[0] - path[-1])) < 1e-6:
            path = path[:-1]
        require(
            0 <= self.first < len(path),
            f"route.first must be a way-point of the tour, 0 to {len(path) - 1}, got {self.first}",
        )
        path = np.roll(path, -self.first, axis=0)
        path = np.concatenate([path, path[:1]])
        return path[::-1] if self.backwards else path


class Controller:
    """Driver that steers 50 times a second with limited acceleration, and rests at its goal."""

    def __init__(self, robot: Robot, last_s: float) -> None:
        linear = robot.max_acceleration_mps2
        # (2,) of v and omega, m/s^2 and rad/s^2: half of a wheel's acceleration for each
        self._most = np.array([0.5 * linear, linear / robot.nominal.track_m])
        self._velocity = np.zeros(2)
        self._rest_ticks: int | None = None
        self._last_tick, self._late = round(last_s / TICK_S), False
        self._tick = 0

    def command(self, tick: int, pose: Array) -> Array | None:
        """Velocity (2,) of the tick; None when the robot has rested at its goal."""
        if self._rest_ticks is not None:
            self._rest_ticks -= 1
            return None if self._rest_ticks < 0 else np.zeros(2)
        if tick % CONTROL_TICKS:
            return self._velocity
        self._tick, self._late = tick, tick >= self._last_tick
        wanted = self._wanted(pose)
        if wanted is None:
            self._rest_ticks = 60
            return np.zeros(2)
        step = CONTROL_TICKS * TICK_S * self._most
        self._velocity = self._velocity + np.clip(wanted - self._velocity, -step, step)
        return self._velocity

    @property
    def trouble(self) -> str | None:
        """`incomplete` (far too slow), else None."""
        return "incomplete" if self._late else None

    def _wanted(self, pose: Array) -> Array | None:
        """Velocity (2,) to go for; None at the goal."""
        raise NotImplementedError

    def _pursued(
        self,
        goal: Array,
        pose: Array,
        speed_mps: float,
        look_ahead_m: float,
        limit: float,
        left_m: float,
    ) -> Array:
        """Velocity (2,) on the arc to a point (2,) of a path of which `left_m` are left.

        `limit` is that of the turn rate, rad/s.
        """
        bearing = _bearing(goal - pose[:2], pose)
        distance = max(float(np.hypot(*(goal - pose[:2]))), 1e-3)
        brake = math.sqrt(2.0 * 0.8 * self._most[0] * max(left_m, 0.0))
        if abs(bearing) > 0.6:  # too sharp for an arc: slow down and turn on the spot
            return np.array([0.0, math.copysign(limit, bearing)])
        v = min(speed_mps * math.cos(bearing) ** 4, brake)
        omega = 2.0 * v * math.sin(bearing) / max(distance, 0.5 * look_ahead_m)
        return np.array([max(v, 0.01), min(max(omega, -limit), limit)])


class Pursuit(Controller):
    """Driver of a Tour: pure pursuit."""

    def __init__(self, tour: Tour, robot: Robot, path: Array) -> None:
        self._tour, self._path = tour, path
        self._along_m = _along_m(path)
        self._done_m, self._off_m = 0.0, 0.0
        super().__init__(robot, 4.0 * self._along_m[-1] / tour.speed_mps + 60.0)

    @property
    def trouble(self) -> str | None:
        """`off_route` or `incomplete` (far too slow), else None."""
        return "off_route" if self._off_m > self._tour.tolerance_m else super().trouble

    def _project(self, pose: Array) -> None:
        """Advance the progress along the path to the nearest point not far ahead."""
        low = int(np.searchsorted(self._along_m, self._done_m, side="right")) - 1
        low = min(low, len(self._path) - 2)  # past the goal, the last leg is still the nearest
        ahead_m = self._done_m + 2.0 * self._tour.look_ahead_m
        high = min(int(np.searchsorted(self._along_m, ahead_m)) + 1, len(self._path))
        best = math.inf
        for i in range(low, min(max(high, low + 2), len(self._path)) - 1):
            start, way = self._path[i], self._path[i + 1] - self._path[i]
            length = self._along_m[i + 1] - self._along_m[i]
            share = min(max(float((pose[:2] - start) @ way / length**2), 0.0), 1.0)
            at_m = self._along_m[i] + share * length
            if not self._done_m - 1e-9 <= at_m <= ahead_m:
                at_m = min(max(at_m, self._done_m), ahead_m)
                share = (at_m - self._along_m[i]) / length
            x, y = (pose[:2] - start - share * way).tolist()
            gap = float(np.hypot(x, y))
            if gap < best - 1e-9:
                best, done_m = gap, at_m
        self._done_m, self._off_m = done_m, best

    def _wanted(self, pose: Array) -> Array | None:
        self._project(pose)
        left_m = self._along_m[-1] - self._done_m
        if left_m < 0.02 and self._velocity[0] < 0.05:
            return None
        tour = self._tour
        goal_m = self._done_m + tour.look_ahead_m
        goal = np.array([np.interp(goal_m, self._along_m, way) for way in self._path.T])
        return self._pursued(
            goal, pose, tour.speed_mps, tour.look_ahead_m, tour.turn_rate_radps, left_m
        )


@options("route")
class GoToPoints(SteeredOptions):
    """One point after another: turn on the spot towards it, then drive to it.

    The closed loop of puzzlebot2024: a ControlNode that steers by the pose on `/odom` (section
    "Obtención kr y kl", image 1). The report prints neither its control law nor its gains,
    tolerance, speeds or points; it says only that by its odometry the robot reaches the points
    (section "Problemas encontrados"). The law here is the proportional one that is usual for such
    nodes: with the point at distance rho and bearing alpha from the believed pose, omega =
    gain_bearing alpha, and v = gain_distance rho, or 0 while abs(alpha) is above `turn_above_rad`.
    Both are limited, as are their accelerations. The numbers are ours.
    """

    points: Points
    """[[x, y], ...], m, in the frame of the start pose."""
    gain_distance: Positive
    """Gain of v, 1/s."""
    gain_bearing: Positive
    """Gain of omega, 1/s."""
    turn_above_rad: Positive
    """Bearing above which the robot turns on the spot."""
    tolerance_m: Positive
    """Believed distance at which a point counts as reached."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.points, "route.points must be at least one point [x, y], m")

    def start(self, world: World, robot: Robot) -> tuple[Array, GoToPoint]:
        """Start pose (3,) of the world, and the driver."""
        path = np.array([(0.0, 0.0), *self.points])
        return world.start_pose, GoToPoint(self, robot, transform(world.start_pose, path))


class GoToPoint(Controller):
    """Driver of GoToPoints."""

    def __init__(self, route: GoToPoints, robot: Robot, path: Array) -> None:
        self._route, self._points, self._reached = route, path[1:], 0
        turns_s = math.pi * len(self._points) / route.turn_rate_radps
        super().__init__(robot, 4.0 * (_along_m(path)[-1] / route.speed_mps + turns_s) + 60.0)

    def _wanted(self, pose: Array) -> Array | None:
        route, offset = self._route, self._points[self._reached] - pose[:2]
        if np.hypot(*offset) <= route.tolerance_m:
            self._reached += 1
            if self._reached == len(self._points):
                return None
            offset = self._points[self._reached] - pose[:2]
        bearing = _bearing(offset, pose)
        most = route.turn_rate_radps
        omega = min(max(route.gain_bearing * bearing, -most), most)
        v = min(route.gain_distance * float(np.hypot(*offset)), route.speed_mps)
        return np.array([v if abs(bearing) <= route.turn_above_rad else 0.0, omega])


def _bearing(offset: Array, pose: Array) -> float:
    """Direction of an offset (2,) in map as the robot sees it, rad, in [-pi, pi]."""
    bearing = math.atan2(offset[1], offset[0]) - pose[2]
    return math.atan2(math.sin(bearing), math.cos(bearing))


def _lengthened(path: Array, distance_m: float | None) -> Array:
    """Path (P, 2) cut or repeated to the wanted length, without points that coincide."""
    path = path[np.concatenate([[True], np.hypot(*np.diff(path, axis=0).T) > 1e-6])]
    if distance_m is None:
        return path
    closed = bool(np.hypot(*(path[0] - path[-1])) < 1e-6)
    lap = path
    while _along_m(path)[-1] < distance_m:
        lap = lap if closed else lap[::-1]
        path = np.concatenate([path, lap[1:]])
    along = _along_m(path)
    last = int(np.searchsorted(along, distance_m))
    share = (distance_m - along[last - 1]) / (along[last] - along[last - 1])
    end = path[last - 1] + share * (path[last] - path[last - 1])
    return np.concatenate([path[:last], end[None]])


def _along_m(path: Array) -> Array:
    """Distance (P,) along a path (P, 2) to each of its points, m."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])


def _merged(segments: Iterable[Segment]) -> list[Segment]:
    """Check the segments; join neighbours of the same velocity."""
    merged: list[Segment] = []
    for i, segment in enumerate(segments):
        v, omega, duration_s = segment
        require(
            duration_s > 0.0,
            f"route.segments[{i}] must have a positive duration, got {segment!r}",
        )
        if merged and merged[-1][:2] == (v, omega):
            duration_s += merged.pop()[2]
        merged.append((v, omega, duration_s))
    return merged


def _trapezoid(segment: Segment, robot: Robot) -> tuple[float, float, float]:
    """Plateau and ramp times, s, and the share of the velocity that the plateau reaches."""
    v, omega, duration_s = segment
    track_m = max(robot.track_m, robot.nominal.track_m)  # neither body nor wheels are hurried
    hurry = max(robot.wheel_radius_m / robot.nominal.wheel_radius_m, 1.0)
    ramp_s = hurry * (abs(v) + abs(omega) * track_m / 2.0) / robot.max_acceleration_mps2
    if ramp_s <= duration_s:
        return duration_s - ramp_s, ramp_s, 1.0
    # peak share p reached after p ramp_s: the area p^2 ramp_s must be the duration
    share = math.sqrt(duration_s / ramp_s)
    return 0.0, share * ramp_s, share


def _held(time_s: Array, segment: Segment, robot: Robot) -> Array:
    """Integral of the velocity's share from the segment's start to `time_s`, s."""
    plateau_s, ramp_s, share = _trapezoid(segment, robot)
    if ramp_s == 0.0:
        return np.clip(time_s, 0.0, plateau_s)
    up = np.clip(time_s, 0.0, ramp_s)
    level = np.clip(time_s - ramp_s, 0.0, plateau_s)
    down = np.clip(time_s - ramp_s - plateau_s, 0.0, ramp_s)
    return share * (up**2 / (2.0 * ramp_s) + level + down - down**2 / (2.0 * ramp_s))


TABLE_1: dict[str, OpenLoop] = {
    "linear_1": OpenLoop(segments=((0.5, 0.0, 2.0),)),
    "linear_2": OpenLoop(segments=((0.5, 0.0, 5.0),)),
    "linear_3": OpenLoop(segments=((0.7, 0.0, 2.0),)),
    "linear_4": OpenLoop(segments=((0.3, 0.0, 2.0),)),
    "angular_1": OpenLoop(segments=((0.0, 0.5, 3.0),)),
    "angular_2": OpenLoop(segments=((0.0, 0.5, 5.0),)),
    "angular_3": OpenLoop(segments=((0.0, 0.5, 10.0),)),
    "angular_4": OpenLoop(segments=((0.0, 0.8, 3.0),)),
    "angular_5": OpenLoop(segments=((0.0, 0.2, 5.0),)),
}
"""The nine manoeuvres of puzzlebot2024, table 1.

The report drops angular case 3 because its heading was wrapped; unwrapped it is as good as the
others, so it is kept.
"""
