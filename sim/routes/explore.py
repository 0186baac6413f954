"""Exploration: robots that choose for themselves where to drive next.

All robots of a team share one occupancy grid, as if they could always talk, at the poses that their
controllers believe. About once a second the goals of the team are looked at: who has reached its
frontier, or sees that another robot has done away with it, gets a new one by the strategy.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from pydantic import NonNegativeInt

from sim import se2
from sim.arrays import Array, Ints
from sim.errors import InputError, require
from sim.options import Point, Positive, options
from sim.robot.base import TICK_S, Robot
from sim.routes.feedback import CONTROL_TICKS
from sim.routes.frontiers import (
    Mask,
    Ways,
    adjacent,
    clearance,
    disc,
    frontiers,
    in_sight,
    middle_of,
    nearest,
    unknown_in_sight,
)
from sim.routes.route import Controller, DriveLength, PursuitOptions
from sim.sensors.base import Reading, Sensors, sensor_of
from sim.sensors.laser import Laser
from sim.worlds.grid_mapping import ScanGrid
from sim.worlds.world import World

Strategy = Literal[
    "random", "nearest_frontier", "shared_frontiers", "information_gain", "coordinated"
]

_LEAST_FRONTIER_M = 0.6  # shorter ones lead nowhere that a robot fits in
_ROBOT_M = 0.6  # from a robot's middle, within which an echo is that robot
_APART_M = 1.0  # at which a robot waits behind another
_ARRIVED_M, _GIVEN_UP_M = 0.4, 1.0
_SHARED_OUT = ("shared_frontiers", "coordinated")
_MOST_SEEN = 0.95  # of a goal's worth that goes to another; a robot is never left without one


@options("route")
class Explore(PursuitOptions):
    """Drive to frontiers of the map that the robots of a team make as they go."""

    strategy: Strategy
    """Which frontier a robot goes to. `random`: any. `nearest_frontier`: that of the shortest way
    (Yamauchi 1998). `information_gain`: that of the greatest A exp(-L / `decay_m`), with the
    unknown area A in sight of it and the way L (Gonzalez-Banos and Latombe 2002). `coordinated`:
    the same, but the robots choose one after another, best choice first, and what a frontier is
    worth falls by the chance that it is seen from one already chosen (Burgard et al. 2005).
    `shared_frontiers`: so shared out, but by the way alone (A = 1)."""
    distance_m: DriveLength
    """Where a robot ends, by its own reckoning, if the team sees no frontier any more before."""
    draw: NonNegativeInt = 0
    """Seed of the random strategy."""
    decay_m: Positive = 5.0
    """Way over which a frontier's worth falls by e: all strategies but the first two."""
    laser: str = "laser"
    """Name of the sensor that the grid is made with."""
    resolution_m: Positive = 0.2
    """Side of a cell."""
    clearance_m: Positive = 0.55
    """Least distance of a way from anything that the grid holds occupied."""
    replan_s: Positive = 1.0
    """How often goals and ways are looked at."""
    start_offset_m: Point = (0.0, 0.0)
    """Of the start from the world's start pose, in its axes."""

    def start(self, world: World, robot: Robot) -> tuple[Array, Explorer]:
        """Start pose (3,) beside the world's, and the driver."""
        pose = se2.compose(world.start_pose, np.array([*self.start_offset_m, 0.0]))
        return pose, Explorer(self, robot, world, pose)

    def about_s(self, world: World, robot: Robot) -> float:
        """About how long the drive takes, s, if frontiers are left all along."""
        return self.distance_m / self.speed_mps

    @property
    def common(self) -> Explore:
        """What the routes of a team have in common."""
        return dataclasses.replace(self, start_offset_m=(0.0, 0.0), feedback="truth")


class Explorer(Controller):
    """Driver of Explore."""

    _crew: Crew

    def __init__(self, route: Explore, robot: Robot, world: World, pose: Array) -> None:
        super().__init__(robot, 4.0 * route.distance_m / route.speed_mps + 60.0)
        self._route, self._world = route, world
        self._driven_m = 0.0
        self._way = np.zeros((0, 2))
        self.goal: Ints | None = None  # cell of a frontier
        self.ended, self.pose = False, pose

    def begin(self, sensors: Sensors, drivers: Sequence[object]) -> None:
        """Look at the laser, and join the other explorers of the team."""
        try:
            self._laser = sensor_of(sensors, self._route.laser, Laser)
        except InputError as error:
            raise InputError(f"route.laser: {error}") from None
        team = [driver for driver in drivers if isinstance(driver, Explorer)]
        require(
            self._route.common == team[0]._route.common,
            "the routes of a team's explorers differ in start_offset_m and feedback alone",
        )
        if self is team[0]:
            crew = Crew(self._route, self._world, self._laser, team)
            for driver in team:
                driver._crew = crew

    def see(self, pose: Array, readings: Mapping[str, Reading]) -> None:
        """Add a scan to the grid, at the pose (3,) that is believed."""
        self.pose = pose
        if self._route.laser in readings:
            self._crew.add(self, readings[self._route.laser]["ranges_m"])

    def follow(self, way: Array) -> None:
        """Take a way (P, 2) m in map to the goal; without points the robot waits."""
        self._way = way

    def is_driving(self, tick: int) -> bool:
        """Whether the robot has neither ended nor hit something."""
        return not self.ended and tick - self._tick <= CONTROL_TICKS

    @property
    def arrived(self) -> bool:
        """Whether the robot is at the end of its way."""
        return len(self._way) > 0 and bool(np.hypot(*(self._way[-1] - self.pose[:2])) < _ARRIVED_M)

    def _wanted(self, pose: Array) -> Array | None:
        self.pose = pose
        self._driven_m += abs(float(self._velocity[0])) * CONTROL_TICKS * TICK_S
        left_m = self._route.distance_m - self._driven_m
        if left_m <= 0.0:
            self.ended, self.goal = True, None
            return None
        self._crew.plan(self._tick)
        if len(self._way) == 0:
            return np.zeros(2) if self._crew.busy else None
        if self.arrived or self._crew.gives_way(self):
            return np.zeros(2)
        route = self._route
        away_m = np.hypot(*(self._way - pose[:2]).T)
        self._way = self._way[int(np.argmin(away_m)) :]
        beyond = np.flatnonzero(away_m[-len(self._way) :] >= route.look_ahead_m)
        goal = self._way[beyond[0] if len(beyond) else -1]
        return self._pursued(
            goal, pose, route.speed_mps, route.look_ahead_m, route.turn_rate_radps, left_m
        )


class Crew:
    """The explorers of a team, and the grid that they share.

    It covers the walls of the world, which bound the area to explore, and the laser's range about
    it, so that no beam leaves it.
    """

    def __init__(
        self, route: Explore, world: World, laser: Laser, team: Sequence[Explorer]
    ) -> None:
        self._route, self._laser, self._team = route, laser, team
        self._rng = np.random.default_rng(route.draw)
        self._next_tick = 0
        ends = world.walls.reshape(-1, 2)
        require(len(ends) > 0, f"route: world {world.name} has no walls that bound what to explore")
        self._low, self._high = ends.min(axis=0), ends.max(axis=0)
        reach_m = laser.max_range_m + 1.0
        low, high = self._low - reach_m, self._high + reach_m
        self._grid = ScanGrid.over(low, high, route.resolution_m)
        self._given_up = np.zeros(self._grid.log_odds.shape, bool)

    @property
    def busy(self) -> bool:
        """Whether a robot has a goal, or the goals have not been looked at yet."""
        return self._next_tick == 0 or any(robot.goal is not None for robot in self._team)

    def gives_way(self, robot: Explorer) -> bool:
        """Whether a robot of lower number that has a goal is close ahead of this one."""
        for other in self._team:
            if other is robot:
                return False
            off = se2.between(robot.pose, other.pose)
            drives = other.goal is not None and other.is_driving(robot._tick)
            if drives and off[0] > 0.0 and np.hypot(*off[:2]) < _APART_M:
                return True
        return False

    def add(self, robot: Explorer, ranges_m: Array) -> None:
        """Add a robot's scan (beams,); what it sees of other robots says nothing.

        Robots do not collide, and a scan from within another robot's body is left out.
        """
        eye, most_m = se2.compose(robot.pose, self._laser.mount.pose), self._laser.max_range_m
        if np.any(eye[:2] < self._low) or np.any(eye[:2] > self._high):
            return
        others = np.array([other.pose[:2] for other in self._team if other is not robot])
        others = others.reshape(-1, 2)
        if np.any(np.hypot(*(eye[:2] - others).T) < _ROBOT_M):
            return
        angles = eye[2] + self._laser.bearings_rad
        # a beam without a return clears the cells up to the greatest range
        ranges = np.where(self._laser.returned(ranges_m), ranges_m, 2.0 * most_m)
        ends = eye[:2] + ranges[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
        for other in others:
            ranges[np.hypot(*(ends - other).T) < _ROBOT_M] = 0.0
        self._grid.add(eye[None], ranges[None].astype(np.float32), self._laser.bearings_rad, most_m)

    def plan(self, tick: int) -> None:
        """Reconsider the goals and paths of all robots that drive, if it is time to."""
        if tick < self._next_tick or self._grid.n_scans == 0:
            return
        self._next_tick = tick + max(round(self._route.replan_s / TICK_S), 1)
        robots = [robot for robot in self._team if robot.is_driving(tick)]
        for robot in self._team:
            robot.goal = robot.goal if robot in robots else None
        m, unknown = self._grid.resolution_m, self._grid.last_scan == 0
        occupied = self._grid.log_odds > 0.0
        free = ~unknown & ~occupied
        passable = free & (clearance(occupied) * m >= self._route.clearance_m)
        if not passable.any():
            return
        ways = Ways.over(passable, self._grid.cells(np.array([robot.pose for robot in robots])))
        self._drop_goals(robots, free & adjacent(unknown), ways)
        edges = frontiers(free & ~self._given_up, unknown, max(round(_LEAST_FRONTIER_M / m), 1))
        self._give_goals(robots, edges, ways, occupied, unknown)
        for number, robot in enumerate(robots):
            cells = np.zeros((0, 2), np.int64)
            if robot.goal is not None:
                cells = ways.to(number, nearest(passable, robot.goal[None])[0])
            robot.follow(self._grid.middles_m(cells))

    def _drop_goals(self, robots: Sequence[Explorer], edge: Mask, ways: Ways) -> None:
        """Drop goals without a way or frontier; give up those that are still one on arrival."""
        m = self._grid.resolution_m
        for number, robot in enumerate(robots):
            if robot.goal is None:
                continue
            if robot.arrived:
                self._given_up |= disc(edge.shape, robot.goal, _GIVEN_UP_M / m)
            [stop] = nearest(ways.passable, robot.goal[None])
            left = np.any(disc(edge.shape, robot.goal, _LEAST_FRONTIER_M / m) & edge)
            if robot.arrived or not left or not math.isfinite(ways.cost[number, *stop]):
                robot.goal = None

    def _give_goals(
        self, robots: Sequence[Explorer], edges: Sequence[Ints], ways: Ways, occupied: Mask,
        unknown: Mask,
    ) -> None:  # fmt: skip
        """Give the robots without a goal one, best choice first."""
        waiting = [number for number, robot in enumerate(robots) if robot.goal is None]
        if not waiting or not edges:
            return
        strategy, m = self._route.strategy, self._grid.resolution_m
        goals = np.array([middle_of(cells) for cells in edges])
        cost_m = m * ways.cost[:, *nearest(ways.passable, goals).T]  # (robots, goals)
        reach = self._laser.max_range_m / m
        if strategy == "random":
            score = self._rng.random(cost_m.shape)
        elif strategy == "nearest_frontier":
            score = -cost_m
        else:
            score = -cost_m / self._route.decay_m
            if strategy != "shared_frontiers":
                areas = [unknown_in_sight(occupied, unknown, goal, reach) for goal in goals]
                score += np.log(np.maximum(areas, 1.0))
        score[~np.isfinite(cost_m)] = -np.inf
        if strategy in _SHARED_OUT:
            for robot in robots:
                if robot.goal is not None:
                    score += np.log(_left(occupied, robot.goal, goals, reach))
        taken = np.full(len(robots), True)
        taken[waiting] = False
        while not taken.all():
            best = np.where(taken[:, None], -np.inf, score)
            number, goal = divmod(int(np.argmax(best)), len(goals))
            if not math.isfinite(best[number, goal]):
                return
            taken[number], robots[number].goal = True, goals[goal]
            if strategy in _SHARED_OUT:
                score += np.log(_left(occupied, goals[goal], goals, reach))


def _left(occupied: Mask, at: Ints, goals: Ints, reach: float) -> Array:
    """Share (N,) that goals keep of their worth when a robot goes to one (2,)."""
    return 1.0 - _MOST_SEEN * in_sight(occupied, at, goals, reach)
