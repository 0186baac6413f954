"""People who walk from place to place, and give way to robots, walls and one another."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import numpy as np
from pydantic import NonNegativeInt

from sim.arrays import Array, Bools, Ints
from sim.compiled import njit
from sim.errors import require
from sim.options import Positive, options
from sim.people.ground import Ground
from sim.robot.base import TICK_S, Robot
from sim.robot.collisions import half_footprint_m
from sim.routes.feedback import CONTROL_TICKS
from sim.routes.frontiers import Ways
from sim.se2 import wrap
from sim.worlds.world import World

STEP_S = CONTROL_TICKS * TICK_S  # between two decisions of a person
_AHEAD = 2  # points along the way, of the one that is walked to
_LOOK_S = 0.7  # how far ahead a step is judged
_STUCK_STEPS, _STUCK_M = 75, 0.3  # in so many steps less far than that: another place is sought
_KEPT_OFF_M, _KEPT_OFF_AT_REST_M = 0.1, 0.02  # from a robot, beyond what it needs to stop
_AT_REST_MPS = 0.01
_PATIENCE_STEPS, _ASIDE_STEPS = 500, 150  # of a robot that stands; people step aside for so long
_ASIDE_M = 1.0  # from a robot, of those who do
_PRESSED_M = 0.2  # gap to a robot below which people squeeze past one another
_FIRST_M = 1.0  # between people, and from robots, at the start
_PLACES_PER_M2 = 0.1  # places to walk to
_TURNS = np.radians([0, 20, -20, 45, -45, 75, -75, 105, -105, 140, -140, 180])


@options("people")
class People:
    """The key `people`: passers-by, each a torso on two legs."""

    n: NonNegativeInt = 0
    """How many walk about."""
    min_speed_mps: Positive = 0.5
    """Each walks at a speed of its own, drawn between this and the next (0.4 to 1.6 in corridors:
    Weidmann 1993, "Transporttechnik der Fussgänger")."""
    max_speed_mps: Positive = 1.2
    stride_m: Positive = 0.7
    """Two steps: the legs swing a quarter of it to the front and the back."""
    leg_radius_m: Positive = 0.055
    legs_apart_m: Positive = 0.18
    """Between the middles of the legs, seen from the front."""
    legs_top_m: Positive = 0.8
    """Below it a laser sees legs, above it the torso."""
    torso_radius_m: Positive = 0.2
    height_m: Positive = 1.7
    within_m: Positive | None = None
    """How far from a robot the places lie that they walk to; null: anywhere in the world."""

    def __post_init__(self) -> None:
        require(
            self.min_speed_mps <= self.max_speed_mps,
            "people.min_speed_mps must not be above people.max_speed_mps",
        )
        require(self.legs_top_m < self.height_m, "people.legs_top_m must be below people.height_m")

    @property
    def radius_m(self) -> float:
        """Of the upright cylinder that holds a person, whatever the legs do."""
        legs_m = math.hypot(self.stride_m / 4.0, self.legs_apart_m / 2.0) + self.leg_radius_m
        return max(self.torso_radius_m, legs_m)


class Crowd:
    """The people of a world at work, 50 decisions a second; in between they move evenly.

    `now_s` is the time.

    Parameters
    ----------
    robots, poses
        Who drives among them, and where each starts (3,).

    Raises
    ------
    InputError
        If there is no room for so many.
    """

    def __init__(
        self,
        people: People,
        world: World,
        robots: Sequence[Robot],
        poses: Sequence[Array],
        rng: np.random.Generator,
    ) -> None:
        self.people, self._rng = people, rng
        self._ground = Ground.of(world, people.height_m, people.radius_m)
        self._robots = [*robots]
        self._reach_m = [math.hypot(*half_footprint_m(robot)) for robot in robots]
        self._brake_mps2 = [0.5 * robot.max_acceleration_mps2 for robot in robots]
        cells = np.argwhere(self._ground.passable)
        area_m2 = len(cells) * (self._ground.cell_m * self._ground.per_way) ** 2
        n_places = min(len(cells), int(20 + _PLACES_PER_M2 * area_m2))
        self._places = cells[rng.choice(len(cells), n_places, replace=False)]
        self._ways = functools.lru_cache(maxsize=64)(
            lambda place: Ways.over(self._ground.passable, self._places[place, None])
        )
        self._last, self.now_s = np.array(poses)[:, :2], 0.0
        first = self._starts(cells)
        self._speeds = rng.uniform(people.min_speed_mps, people.max_speed_mps, people.n)
        headings = rng.uniform(-math.pi, math.pi, people.n)
        walked = rng.uniform(0.0, people.stride_m, people.n)
        self._states = [np.column_stack([first, headings, walked])]  # (n, 4) at each decision
        self._way = [np.zeros((0, 2)) for _ in range(people.n)]
        self._stuck, self._marked = np.zeros(people.n, bool), first
        self._stood = np.zeros(len(robots), np.int64)  # steps for which a robot has stood
        self._asked = np.zeros(len(robots), np.int64)  # and those for which people step aside

    def _starts(self, cells: Ints) -> Array:
        """First places (n, 2), clear of robots and of each other."""
        taken: list[Array] = []
        for spot in self._ground.middles_m(self._rng.permutation(cells)):
            if len(taken) == self.people.n:
                break
            off_robots = np.hypot(*(self._last - spot).T) - self._reach_m
            apart = [*off_robots, *(math.dist(spot, other) for other in taken)]
            near = self.people.within_m is None or off_robots.min() <= self.people.within_m
            if near and min(apart) >= _FIRST_M + self.people.radius_m:
                taken.append(spot)
        require(
            len(taken) == self.people.n,
            f"people.n={self.people.n}: there is room for {len(taken)} only; take fewer",
        )
        return np.array(taken)

    def advance(self, tick: int, poses: Sequence[Array]) -> None:
        """Advance to this tick, with the robots at poses (3,); decide on a step if one is due."""
        self.now_s = tick * TICK_S
        if tick % CONTROL_TICKS:
            return
        now = np.array(poses)[:, :2]
        speeds = np.hypot(*(now - self._last).T) / STEP_S
        self._last = now
        stops_m = speeds**2 / (2.0 * np.array(self._brake_mps2))
        stops_m += np.where(speeds > _AT_REST_MPS, _KEPT_OFF_M, _KEPT_OFF_AT_REST_M)
        obstacles = np.column_stack([now, self._reach_m, stops_m])
        state, radius_m = self._states[-1].copy(), self.people.radius_m
        targets = np.array(
            [self._target(person, state[person, :2]) for person in range(len(state))]
        )
        self._stood = np.where(speeds > _AT_REST_MPS, 0, self._stood + 1)
        self._asked = np.where(self._stood >= _PATIENCE_STEPS, _ASIDE_STEPS, self._asked - 1)
        clear_m = np.full(len(state), radius_m)  # that each keeps from walls
        for robot in np.flatnonzero(self._asked > 0).tolist():
            asked = self._step_aside(robot, poses[robot], targets)
            # the cells know a clearance to two diagonals, and keep it by one of them at least
            clear_m[asked] = self.people.torso_radius_m - math.sqrt(2.0) * self._ground.cell_m
        ground = self._ground
        if len(self._states) % _STUCK_STEPS == 0:
            self._stuck = np.hypot(*(state[:, :2] - self._marked).T) < _STUCK_M
            self._marked = state[:, :2].copy()
        _walk(
            state, targets, self._speeds, obstacles,
            (ground.clear_m, ground.corner_m[0], ground.corner_m[1], ground.cell_m), clear_m,
            radius_m, self.people.torso_radius_m,
        )  # fmt: skip
        self._states.append(state)

    def _target(self, person: int, at: Array) -> Array:
        """Point (2,) that a person walks to: ahead on its way, or on a new one."""
        way = self._way[person]
        if len(way):
            away_m = np.hypot(*(way[:20] - at).T)
            way = way[int(np.argmin(away_m)) :]
        if len(way) == 0 or math.dist(at, way[-1]) < 0.2 or self._stuck[person]:
            # for somebody in the way of a robot: of several places, one that lies behind the back
            tries = 8 if self._stuck[person] else 1
            every = [self._ways(self._choose()) for _ in range(tries)]
            ways = every[0] if tries == 1 else max(every, key=lambda ways: self._lead(ways, at))
            way = self._ground.way(ways, at)
            self._stuck[person] = False
        self._way[person] = way
        return _ahead(way) if len(way) else at

    def _step_aside(self, number: int, pose: Array, targets: Array) -> Bools:
        """Let those ahead of a robot, which waits at a pose (3,), walk to its sides: who (n,)."""
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        left = np.array([-sin, cos])
        gaps, offsets = self.gaps_m(number, pose)
        asked: Bools = (offsets @ [cos, sin] > 0.0) & (gaps < _ASIDE_M)
        side = np.where(offsets @ left < 0.0, -1.0, 1.0)
        targets[asked] = (self._states[-1][:, :2] + side[:, None] * left)[asked]
        return asked

    def _lead(self, ways: Ways, at: Array) -> float:
        """How much shorter the way to a place is from a point (2,) than from the nearest robot."""
        spots = np.vstack([at, self._last[np.argmin(np.hypot(*(self._last - at).T))]])
        mine, robots = (ways.cost[0, *self._ground.cell_of(spot)[0]] for spot in spots)
        return float(robots - mine) if math.isfinite(mine) else -math.inf

    def _choose(self) -> int:
        """A place to walk to."""
        near = np.arange(len(self._places))
        if self.people.within_m is not None:
            spots = self._ground.middles_m(self._places)
            off_m = np.min([np.hypot(*(spots - robot).T) for robot in self._last], axis=0)
            close = np.flatnonzero(off_m <= self.people.within_m)
            near = close if len(close) else np.argsort(off_m)[:5]
        return int(self._rng.choice(near))

    def at(self, stamps: Array) -> Array:
        """States (..., n, 4) at stamps (...,) s up to the last decision's end.

        Columns are x, y, m, heading, rad, and the distance walked, m.
        """
        steps = np.clip(np.asarray(stamps, float) / STEP_S, 0.0, len(self._states) - 1.0)
        low = np.minimum(steps.astype(np.int64), max(len(self._states) - 2, 0))
        high = np.minimum(low + 1, len(self._states) - 1)
        share = (steps - low)[..., None, None]
        first, last = int(low.min()), int(high.max())
        states = np.array(self._states[first : last + 1])
        begin, end = states[low - first], states[high - first]
        found: Array = begin + share * (end - begin)
        found[..., 2] = end[..., 2]  # of the step that is under way
        return found

    def tracks(self, stamps: Array) -> Array:
        """Poses (T, n, 3) m, m, rad at stamps (T,)."""
        poses = self.at(stamps)[..., :3]
        poses[..., 2] = wrap(poses[..., 2])
        return poses

    def discs(self, stamps: Array, z_m: float) -> Array:
        """Circles (..., K, 3), x, y, radius, m, that a plane at a height cuts out of people."""
        states, people = self.at(stamps), self.people
        if z_m > people.height_m:
            return np.zeros((*states.shape[:-2], 0, 3))
        if z_m > people.legs_top_m:
            radius = np.full(states[..., :1].shape, people.torso_radius_m)
            return np.concatenate([states[..., :2], radius], axis=-1)
        return self.legs(states)

    def legs(self, states: Array) -> Array:
        """Circles (..., 2 n, 3) of the legs of people in states (..., n, 4).

        The foot on the ground stays there while the body moves half a stride over it; the other
        swings forward.
        """
        people = self.people
        cycle = states[..., 3] / people.stride_m
        swing = people.stride_m / 4.0 * (4.0 * np.abs(cycle - np.floor(cycle + 0.5)) - 1.0)
        cos, sin = np.cos(states[..., 2]), np.sin(states[..., 2])
        found = []
        for side in (-1.0, 1.0):
            ahead, left = side * swing, side * people.legs_apart_m / 2.0
            x = states[..., 0] + cos * ahead - sin * left
            y = states[..., 1] + sin * ahead + cos * left
            found.append(np.stack([x, y, np.full(x.shape, people.leg_radius_m)], axis=-1))
        return np.concatenate(found, axis=-2)

    def gaps_m(self, number: int, pose: Array) -> tuple[Array, Array]:
        """Of a robot at a pose (3,) now: gaps (n,) m to people, and offsets (n, 2) m in map."""
        offsets = self.at(np.array(self.now_s))[:, :2] - pose[:2]
        gaps = np.hypot(*offsets.T) - self._reach_m[number] - self.people.radius_m
        return gaps, offsets

    def touches(self, number: int, pose: Array) -> bool:
        """Whether a person's cylinder overlaps the footprint of a robot at a pose (3,) now."""
        gaps, offsets = self.gaps_m(number, pose)
        if gaps.min() > 0.0:
            return False
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        in_base = np.abs(offsets @ np.array([[cos, -sin], [sin, cos]]))
        outside = np.maximum(in_base - half_footprint_m(self._robots[number]), 0.0)
        return bool(np.hypot(*outside.T).min() < self.people.radius_m)


def _ahead(way: Array) -> Array:
    """Point (2,) of a way (P, 2) to walk to."""
    point: Array = way[min(_AHEAD, len(way) - 1)]
    return point


@njit()
def _clear(field: tuple[Array, float, float, float], x: float, y: float) -> float:
    """No wall is nearer to a point than this, m."""
    clear_m, x0, y0, cell_m = field
    row, column = int((y - y0) / cell_m), int((x - x0) / cell_m)
    if row < 0 or column < 0 or row >= clear_m.shape[0] or column >= clear_m.shape[1]:
        return -1.0
    return float(clear_m[row, column])


@njit()
def _robot_gap(obstacles: Array, x: float, y: float, radius_m: float) -> float:
    """Least gap to a robot, less what it needs to stop, m."""
    least = np.inf
    for k in range(len(obstacles)):
        away = math.hypot(x - obstacles[k, 0], y - obstacles[k, 1])
        least = min(least, away - obstacles[k, 2] - obstacles[k, 3] - radius_m)
    return least


@njit()
def _person_gap(states: Array, me: int, x: float, y: float, radius_m: float) -> float:
    least = np.inf
    for k in range(len(states)):
        if k != me:
            least = min(least, math.hypot(x - states[k, 0], y - states[k, 1]) - 2.0 * radius_m)
    return least


@njit()
def _walk(
    states: Array,
    targets: Array,
    speeds: Array,
    obstacles: Array,
    field: tuple[Array, float, float, float],
    clear_m: Array,
    radius_m: float,
    torso_m: float,
) -> None:
    """Move each person (n, 4) one step, in place.

    Of steps in twelve directions, and none, the one that leads best to the target and to room. No
    step is taken into a wall, nor to a robot or person that is too near already; close to a robot
    people squeeze past one another.
    """
    for i in range(len(states)):
        x, y = states[i, 0], states[i, 1]
        gap, apart = _robot_gap(obstacles, x, y, radius_m), _person_gap(states, i, x, y, radius_m)
        keep_m = min(clear_m[i], _clear(field, x, y))
        wanted = math.atan2(targets[i, 1] - y, targets[i, 0] - x)
        step_m, best, turn = speeds[i] * STEP_S, -0.4, np.nan
        if math.hypot(targets[i, 0] - x, targets[i, 1] - y) < 1e-6:
            best = 2.0  # nowhere to go
        if gap < _PRESSED_M:
            best = -10.0  # rather any step than none
        for k in range(_TURNS.size):
            cos, sin = math.cos(wanted + _TURNS[k]), math.sin(wanted + _TURNS[k])
            nx, ny = x + step_m * cos, y + step_m * sin
            there = _robot_gap(obstacles, nx, ny, radius_m)
            beside = _person_gap(states, i, nx, ny, torso_m)
            if _clear(field, nx, ny) < keep_m or (there < 0.0 and there <= gap):
                continue
            if beside < 0.0 and beside <= apart and gap > _PRESSED_M:
                continue
            look_m = speeds[i] * _LOOK_S
            lx, ly = x + look_m * cos, y + look_m * sin
            score = math.cos(_TURNS[k])
            score -= 1.0 if _clear(field, lx, ly) < radius_m else 0.0
            score += 2.0 * min(_robot_gap(obstacles, lx, ly, radius_m), 0.0) / radius_m
            score += min(_person_gap(states, i, lx, ly, radius_m), 0.0) / radius_m
            if score > best:
                best, turn = score, _TURNS[k]
        if not math.isnan(turn):
            heading = wanted + turn
            states[i, 0] += step_m * math.cos(heading)
            states[i, 1] += step_m * math.sin(heading)
            states[i, 2] = heading
            states[i, 3] += step_m
