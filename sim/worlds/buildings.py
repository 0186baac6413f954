"""Worlds from a few parameters and a random stream.

Each builder is a function `name(*, rng, ...) -> World`, whose parameters are the options of a
world, or a class of options with a method `build(rng) -> World`.
"""

import math
from collections.abc import Sequence
from itertools import pairwise, product
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from pydantic import NonNegativeInt

from sim.arrays import Array
from sim.errors import InputError, require, required
from sim.options import Count, NonNegative, Positive, Share, build, options
from sim.worlds.floor_plan import (
    WALL_HEIGHT_M,
    Plan,
    box_corners,
    check_cells,
    check_margins,
    rectangle_corners,
)
from sim.worlds.furnished import FurnishedOptions
from sim.worlds.grid_file import read_grid
from sim.worlds.grid_tour import plan_tour
from sim.worlds.town import lawn, terrace, town
from sim.worlds.vary import Shares, vary
from sim.worlds.world import World, facing_second
from sim.worlds.world_file import check_tour, read_world

_MOST_GRID_WALLS = 200_000


def empty(*, rng: np.random.Generator, tour_m: float = 10.0) -> World:
    """Open floor without a wall; the tour is a square of side `tour_m`."""
    plan = Plan(tour=[(0, 0), (tour_m, 0), (tour_m, tour_m), (0, tour_m), (0, 0)])
    return plan.world("empty", rng)


def from_file(*, rng: np.random.Generator, path: str) -> World:
    """Read a user's world; see `sim.worlds.world_file` for the format. Nothing in it is random."""
    del rng
    return read_world(Path(path))


def from_grid(
    *,
    rng: np.random.Generator,
    path: str | None = None,
    waypoints: Sequence[list[float]] = (),
    stops: int = 0,
) -> World:
    """Draw a world from an occupancy grid: a wall along each border of its occupied cells.

    Parameters
    ----------
    path
        The grid's YAML file; see `sim.worlds.grid_file`.
    waypoints
        [[x, y], ...] m: the tour. A grid has none of its own, so the route needs way-points if
        these are fewer than two and `stops` is 0.
    stops
        Places, drawn at random, of a tour that is planned if there are no way-points; 2 or more, or
        0 for none.
    """
    path = required(path, "world.path must name a grid's .yaml, such as one `estima map` wrote")
    grid = read_grid(path)
    walls = grid.walls()
    require(
        len(walls) <= _MOST_GRID_WALLS,
        f"{path}: {len(walls)} walls, and {_MOST_GRID_WALLS} are the most; clean the grid, or "
        "make its cells larger",
    )
    try:
        tour = np.array(waypoints, float).reshape(-1, 2)
    except (TypeError, ValueError):
        raise InputError(f"world.waypoints must be points [x, y], m, got {waypoints!r}") from None
    require(stops == 0 or stops >= 2, f"world.stops must be 0, or 2 or more, got {stops}")
    if len(tour) == 0 and stops:
        tour = plan_tour(grid, stops, rng)
    check_tour(tour, walls, Path(path))
    return World(
        name=Path(path).stem,
        walls=walls,
        wall_z_m=np.tile([0.0, WALL_HEIGHT_M], (len(walls), 1)),
        start_pose=facing_second(tour) if len(tour) >= 2 else np.zeros(3),
        waypoints=tour,
    )


def room(
    *,
    rng: np.random.Generator,
    length_m: float = 8.0,
    width_m: float = 6.0,
    n_objects: int = 6,
    n_landmarks: int = 60,
    look_alike_share: float = 0.0,
    changed_share: float = 0.0,
) -> World:
    """Build one furnished room; the tour goes round it, 1.2 m off the walls."""
    check_margins(length_m=length_m - 3.0, width_m=width_m - 3.0)
    plan = Plan()
    plan.rectangle((0, 0), (length_m, width_m))
    plan.place("room", 0, 0, length_m, width_m)
    a, b = 1.2, (length_m - 1.2, width_m - 1.2)
    plan.tour = [(a, a), (b[0], a), (b[0], b[1]), (a, b[1]), (a, a)]
    plan.furnish(rng, (0, 0), (length_m, width_m), n_objects, size_m=(0.3, 1.0), clearance_m=0.45)
    world = plan.world("room", rng, n_landmarks=n_landmarks, look_alike_share=look_alike_share)
    return vary(plan, world, rng, Shares(changed_share))


def boxes(
    *,
    rng: np.random.Generator,
    n_boxes: int = 12,
    side_m: float = 20.0,
    n_landmarks: int = 0,
    look_alike_share: float = 0.0,
    changed_share: float = 0.0,
) -> World:
    """Scatter boxes in a square hall; the tour runs along its walls."""
    check_margins(side_m=side_m - 3.0)
    plan = Plan()
    plan.rectangle((0, 0), (side_m, side_m))
    a, b = 1.2, side_m - 1.2
    plan.tour = [(a, a), (b, a), (b, b), (a, b), (a, a)]
    plan.furnish(rng, (0, 0), (side_m, side_m), n_boxes, clearance_m=0.5)
    world = plan.world("boxes", rng, n_landmarks=n_landmarks, look_alike_share=look_alike_share)
    return vary(plan, world, rng, Shares(changed_share))


@options("world")
class Rooms(FurnishedOptions):
    """n_x by n_y square rooms with a door between all neighbours.

    The tour goes from room to room: round the outer ring, then, where there is one, round the
    ring inside it, and back.
    """

    n_x: Count = 3
    n_y: Count = 2
    room_m: Positive = 6.0
    door_m: Positive = 1.2
    objects_per_room: NonNegativeInt = 3
    n_landmarks: NonNegativeInt = 200
    on_walls_share: Share = 0.7
    """Share of the landmarks on walls; the others are on objects."""

    def __post_init__(self) -> None:
        require(
            self.n_x * self.n_y >= 2,
            f"world.n_x and n_y must make at least two rooms, got {self.n_x} x {self.n_y}",
        )
        check_cells(self.n_x, self.n_y)
        room_m, door_m = self.room_m, self.door_m
        check_margins(room_m=room_m - 2.0, door_m=door_m - 0.7, wall=room_m - door_m)

    def build(self, rng: np.random.Generator) -> World:
        """Build the world."""
        n_x, n_y, room_m, plan = self.n_x, self.n_y, self.room_m, Plan()
        plan.rectangle((0, 0), (n_x * room_m, n_y * room_m))
        door = [(room_m / 2, self.door_m)]
        corners = [(i * room_m, j * room_m) for i in range(n_x) for j in range(n_y)]
        for x, y in corners:
            plan.place("room", x, y, x + room_m, y + room_m)
            if x < (n_x - 1) * room_m:
                plan.wall((x + room_m, y), (x + room_m, y + room_m), gaps=door)
                plan.door((x + room_m, y + room_m / 2), (1, 0))
            if y < (n_y - 1) * room_m:
                plan.wall((x, y + room_m), (x + room_m, y + room_m), gaps=door)
                plan.door((x + room_m / 2, y + room_m), (0, 1))
        plan.tour = [((i + 0.5) * room_m, (j + 0.5) * room_m) for i, j in _grid_tour(n_x, n_y)]
        for low in corners:
            plan.furnish(rng, low, np.add(low, room_m).tolist(), self.objects_per_room)
        return self.finish(plan, "rooms", rng, self.on_walls_share)


@options("world")
class Corridor(FurnishedOptions):
    """A bare stretch, objects, a bare stretch, a sharp bend, a leg, a round curve, a leg.

    Both turn left. The place `corridor_bare` stops 3 m short of the end wall and of the objects,
    and so do `leg_1` to `leg_3`, the bare stretches before, between and after the bends, where they
    are longer than that.
    """

    bare_m: float = 30.0
    objects_m: float = 15.0
    bare_after_m: NonNegative = 0.0
    second_leg_m: float = 12.0
    curve_radius_m: float = 4.0
    """Radius of the middle of the corridor."""
    third_leg_m: float = 10.0
    width_m: float = 2.2
    n_objects: NonNegativeInt = 8
    n_landmarks: NonNegativeInt = 80

    def __post_init__(self) -> None:
        check_margins(
            bare_m=self.bare_m - 6.0,
            objects_m=self.objects_m,
            second_leg_m=self.second_leg_m,
            third_leg_m=self.third_leg_m - 1.0,
            width_m=self.width_m - 1.8,
            curve_radius_m=self.curve_radius_m - self.width_m / 2 - 0.2,
        )

    def build(self, rng: np.random.Generator) -> World:
        """Build the world."""
        plan, w, r = Plan(), self.width_m, self.curve_radius_m
        x1, x2 = self.bare_m, self.bare_m + self.objects_m + self.bare_after_m
        end, top, xc = x1 + self.objects_m, w + self.second_leg_m, x2 + w / 2
        far = xc - r - self.third_leg_m
        angle = np.linspace(0.0, math.pi / 2, 13)
        arc = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        centre = np.array([xc - r, top])
        outer, inner = centre + (r + w / 2) * arc, centre + (r - w / 2) * arc[::-1]
        ends = [(far, top + r + w / 2), (far, top + r - w / 2)]
        plan.enclosure([(0, 0), (x2 + w, 0), *outer, *ends, *inner, (x2, w), (0, w)])
        plan.place("corridor_bare", 3.0, 0, x1 - 3.0, w)
        plan.place("corridor_objects", x1, 0, end, w)
        plan.place("corner", x2, 0, x2 + w, w)
        legs = (
            (self.bare_after_m, (end + 3.0, 0, x2 - 3.0, w)),
            (self.second_leg_m, (x2, w + 3.0, x2 + w, top - 3.0)),
            (self.third_leg_m, (far + 3.0, top + r - w / 2, xc - r - 3.0, top + r + w / 2)),
        )
        for number, (length, area) in enumerate(legs, 1):
            if length > 6.0:
                plan.place(f"leg_{number}", *area)
        plan.place("curve", xc - r, top, x2 + w, top + r + w / 2)
        middle = [(float(x), float(y)) for x, y in centre + r * arc]
        plan.tour = [(1.0, w / 2), (xc, w / 2), *middle, (far + 1.0, top + r)]
        _line_up(plan, rng, (x1, 0), (end, w), self.n_objects)
        return self.finish(plan, "corridor", rng)


def corridors(
    *,
    rng: np.random.Generator,
    n_objects: list[int],
    changed_share: float = 0.0,
    **lengths_m: list[float],
) -> World:
    """Build a `Corridor` whose sizes are drawn, each between the two ends given."""
    drawn = {name: rng.uniform(ends[0], ends[1]) for name, ends in lengths_m.items()}
    count = int(rng.integers(n_objects[0], n_objects[1] + 1))
    own = {"n_objects": count, "n_landmarks": 0, "changed_share": changed_share}
    return build(Corridor, {**drawn, **own}, "world").build(rng)


def office(
    *,
    rng: np.random.Generator,
    corridor_m: float = 2.2,
    n_landmarks: int = 600,
    look_alike_share: float = 0.1,
    objects_per_room: int = 5,
    rooms_visited: int = 8,
    changed_share: float = 0.0,
    doors_share: float = 0.0,
) -> World:
    """Build an office floor of 66 x 42 m: 22 furnished rooms on two corridor loops.

    The corridors are the outer ring but for the rooms along the south side, and a passage from
    south to north that parts it into two loops. The north corridor is bare for 40 m, without a
    door; the west and the east one have cabinets. The rooms' widths, doors, niches and furniture
    are random. The tour goes round the western loop, then round both, into `rooms_visited` rooms.
    """
    require(
        1.8 < corridor_m <= 3.0, f"world.corridor_m must lie between 1.8 and 3 m, got {corridor_m}"
    )
    require(0 <= rooms_visited <= 22, f"world.rooms_visited must lie in 0-22, got {rooms_visited}")
    plan, c = Plan(), corridor_m
    W, H, south = 66.0, 42.0, 9.0
    passage = 44.0 + rng.uniform(0.0, 1.0)  # west side of the passage between the loops
    plan.rectangle((0, 0), (W, H))
    inner_low, inner_high = south + c, H - c
    blocks = ((c, passage), (passage + c, W - c))
    suites: list[Any] = [(((0.0, south), (W, south)), -1, 7, 9.0)]  # the rooms south of the ring
    row = 8.0
    for number, (left, right) in enumerate(blocks):
        court = number == 0  # between its columns; in the other block they stand back to back
        column = 9.0 if court else 0.5 * (right - left)
        mouth = inner_low + row
        suites += [
            (((left, inner_low), (right, inner_low)), 1, 5 if court else 2, row, "U"),
            (((left, mouth), (left, inner_high)), -1, 2, column, "_"),
            (((right, mouth), (right, inner_high)), 1, 2, column, "_" if court else ""),
        ]
        plan.wall((left, inner_high), (right, inner_high))
        if court:
            plan.close(rectangle_corners((left + column, mouth), (right - column, inner_high)))
    rooms = [room for suite in suites for room in _suite(plan, rng, *suite)]
    x0, xm, x1 = c / 2, passage + c / 2, W - c / 2
    y0, y1 = south + c / 2, H - c / 2
    plan.place("corridor_bare", c, H - c, passage, H)
    plan.place("corridor_objects", 0, inner_low, c, inner_high)
    plan.place("corridor_objects", W - c, inner_low, W, inner_high)
    for x, y in product((0.0, passage, W - c), (south, H - c)):
        plan.place("corner", x, y, x + c, y + c)
    loop = [(x0, y0), (xm, y0), (xm, y1), (x0, y1), (x0, y0)]
    second = [(x1, y0), (x1, y1), (xm, y1), (xm, y0), (x0, y0)]
    plan.tour = _with_visits([*loop, *second], rooms, rng, rooms_visited)
    for low, high in (((0, inner_low), (c, inner_high)), ((W - c, inner_low), (W, inner_high))):
        doors = [r.door for r in rooms if low[0] - 0.1 <= r.door[0] <= high[0] + 0.1]
        _line_up(plan, rng, low, high, 7, keep_off=doors)
    for room in rooms:
        plan.furnish(rng, room.low, room.high, objects_per_room, size_m=(0.4, 1.6))
    world = plan.world("office", rng, n_landmarks=n_landmarks, look_alike_share=look_alike_share)
    return vary(plan, world, rng, Shares(changed_share, doors=doors_share))


def streets(
    *,
    rng: np.random.Generator,
    n_x: int = 3,
    n_y: int = 2,
    block_m: float = 80.0,
    street_m: float = 14.0,
) -> World:
    """Build blocks of terraced houses of differing width, height and setback, with few trees."""
    return town("streets", rng, n_x, n_y, block_m, street_m, terrace, trees_per_block=6)


def campus(
    *,
    rng: np.random.Generator,
    n_x: int = 3,
    n_y: int = 2,
    block_m: float = 80.0,
    street_m: float = 16.0,
    trees_per_block: int = 14,
) -> World:
    """Build blocks with a few turned or L-shaped buildings among lawns and trees."""
    return town("campus", rng, n_x, n_y, block_m, street_m, lawn, trees_per_block)


class _Room(NamedTuple):
    """A room that can be visited: its rectangle, its door, and how to go in."""

    low: Array
    high: Array
    door: Array
    inward: Array


def _suite(
    plan: Plan,
    rng: np.random.Generator,
    ends: tuple[tuple[float, float], tuple[float, float]],
    side: int,
    count: int,
    depth_m: float,
    walls: Literal["", "_", "U"] = "",
) -> list[_Room]:
    """Draw a row of rooms behind a corridor's wall, on its left (side 1) or right (-1).

    `walls` says what else is drawn besides the front and the partitions: `_` the back, `U` the
    back and both ends; the others are walls of something else.
    """
    start, end = np.array(ends)
    length = float(np.hypot(*(end - start)))
    along = (end - start) / length
    inward = side * np.array([-along[1], along[0]])
    share = rng.uniform(0.85, 1.15, count)
    edges = np.concatenate([[0.0], np.cumsum(share / share.sum() * length)])
    doors = [
        (rng.uniform(low + 1.0, high - 1.0), rng.uniform(1.0, 1.2)) for low, high in pairwise(edges)
    ]
    plan.wall(start, end, gaps=doors)
    back = depth_m * inward
    if walls:
        plan.wall(start + back, end + back)
    for corner in (start, end) if walls == "U" else ():
        plan.wall(corner, corner + back)
    rooms = []
    for i, (low, high) in enumerate(pairwise(edges)):
        near, far = start + low * along, start + high * along
        if i + 1 < count:
            plan.wall(far, far + back)
        _niche(plan, rng, start, (low, high), along, back)
        corners = np.array([near, far + back])
        lowest, highest = corners.min(axis=0), corners.max(axis=0)
        plan.place("room", *lowest, *highest)
        door = start + doors[i][0] * along
        plan.door(door, inward)
        rooms.append(_Room(lowest, highest, door, inward))
    return rooms


def _niche(
    plan: Plan,
    rng: np.random.Generator,
    start: Array,
    edges: tuple[float, float],
    along: Array,
    back: Array,
) -> None:
    """Draw a stub of wall from the back or the left side: no two rooms are alike."""
    low, high = edges
    if rng.random() < 0.5:
        foot = start + rng.uniform(low + 1.0, high - 1.0) * along + back
        end = foot - back * rng.uniform(0.1, 0.22)
    else:
        foot = start + low * along + back * rng.uniform(0.55, 0.85)
        end = foot + along * (high - low) * rng.uniform(0.1, 0.22)
    plan.wall(foot, end)


def _with_visits(
    path: list[tuple[float, float]], rooms: list[_Room], rng: np.random.Generator, count: int
) -> list[tuple[float, float]]:
    """Tour along the path that looks into `count` of the rooms, in and out by the door."""
    stops: list[list[tuple[float, _Room, Array]]] = [[] for _ in path]
    for room in (rooms[row] for row in rng.permutation(len(rooms))[:count]):
        feet = []
        for start, end in pairwise(np.array(path)):
            way = end - start
            share = float(np.clip((room.door - start) @ way / (way @ way), 0.0, 1.0))
            feet.append((share, start + share * way))
        # to 1e-9 m, so that of a stretch that is passed twice the first pass counts
        gaps = [round(float(np.hypot(*(room.door - foot))), 9) for _, foot in feet]
        leg = int(np.argmin(gaps))
        stops[leg].append((feet[leg][0], room, feet[leg][1]))
    tour = []
    for point, visits in zip(path, stops, strict=True):
        tour.append(point)
        for _, room, foot in sorted(visits, key=lambda stop: stop[0]):
            tour += [(float(x), float(y)) for x, y in (foot, room.door + 2.0 * room.inward, foot)]
    return tour


def _line_up(
    plan: Plan,
    rng: np.random.Generator,
    low: tuple[float, float],
    high: tuple[float, float],
    count: int,
    keep_off: list[Array] | None = None,
) -> None:
    """Put cabinets against the long walls of a straight corridor, clear of doors."""
    long = 0 if high[0] - low[0] > high[1] - low[1] else 1
    pitch = (high[long] - low[long] - 2.0) / max(count, 1)
    for i in range(count):
        depth, width = rng.uniform(0.25, 0.42), rng.uniform(0.4, 0.7) * min(pitch, 1.8)
        at_high = rng.random() < 0.5
        across = high[1 - long] - depth / 2 - 0.01 if at_high else low[1 - long] + depth / 2 + 0.01
        slack = min(0.5, (pitch - width) / 2 - 0.02)
        position = low[long] + 1.0 + (i + 0.5) * pitch + rng.uniform(-slack, slack)
        centre = (position, across) if long == 0 else (across, position)
        size = (width, depth) if long == 0 else (depth, width)
        if all(abs(door[long] - position) > 0.8 + width / 2 for door in keep_off or []):
            plan.prism(box_corners(centre, size, 0.0), 0.0, rng.uniform(0.8, 1.9))


def _grid_tour(n_x: int, n_y: int) -> list[tuple[int, int]]:
    """Cells (i, j) to go through, neighbours in turn, ending where it began."""
    if min(n_x, n_y) == 1:
        line = [(i, 0) for i in range(n_x)] if n_y == 1 else [(0, j) for j in range(n_y)]
        return [*line, *line[-2::-1]]
    tour = _ring(0, 0, n_x - 1, n_y - 1)
    if min(n_x, n_y) >= 4:
        tour += [(1, 0), *_ring(1, 1, n_x - 2, n_y - 2), (1, 0), (0, 0)]
    return tour


def _ring(i0: int, j0: int, i1: int, j1: int) -> list[tuple[int, int]]:
    """Cells round a rectangle of cells, from its corner and back to it, counter-clockwise."""
    return [
        *((i, j0) for i in range(i0, i1)),
        *((i1, j) for j in range(j0, j1)),
        *((i, j1) for i in range(i1, i0, -1)),
        *((i0, j) for j in range(j1, j0, -1)),
        (i0, j0),
    ]
