"""Worlds where straight walls are few: clutter, curves, corridors that look alike, a large hall."""

import functools
import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field, NonNegativeInt

from sim.arrays import Array
from sim.errors import require
from sim.options import Count, NonNegative, Positive, Share, options
from sim.worlds.floor_plan import (
    Plan,
    arc_points,
    arc_step_rad,
    box_corners,
    check_margins,
    rectangle_corners,
    round_corners,
)
from sim.worlds.furnished import FurnishedOptions
from sim.worlds.world import World

Outline = Callable[[np.random.Generator], Array]
Drawing = Callable[[Plan, Array, np.random.Generator], None]
_OFF_TOUR_M = 0.6  # furniture, from the tour
_TABLE_M, _SEAT_M = 0.74, 0.45  # heights of table tops and seats
_CLOSE_M = 3.0  # off walls and objects: where corridors count as bare


@options("world")
class Clutter(FurnishedOptions):
    """A hall of tables with chairs, potted plants and turned boxes; the tour winds through it.

    At the height of a laser, tables and chairs are legs.
    """

    length_m: Positive = 18.0
    width_m: Positive = 12.0
    n_tables: NonNegativeInt = 9
    chairs_per_table: Annotated[int, Field(ge=0, le=4)] = 4
    n_plants: NonNegativeInt = 10
    n_boxes: NonNegativeInt = 12

    def __post_init__(self) -> None:
        check_margins(length_m=self.length_m - 8.0, width_m=self.width_m - 6.0)

    def build(self, rng: np.random.Generator) -> World:
        """Build the world."""
        plan, low, high = Plan(), (0.0, 0.0), (self.length_m, self.width_m)
        plan.rectangle(low, high)
        plan.place("room", *low, *high)
        left, middle, right = 1.2, self.length_m / 2, self.length_m - 1.2
        south, north, between = 1.2, self.width_m - 1.2, self.width_m / 2
        plan.tour = [
            (left, south), (middle, south), (middle, between), (right, between), (right, north),
            (middle, north), (middle, between), (left, between), (left, south),
        ]  # fmt: skip
        things: tuple[tuple[int, Outline, Drawing], ...] = (
            (self.n_tables, lambda own: _turned((1.9, 1.9), own), self._table),
            (self.n_boxes, lambda own: _turned(own.uniform(0.25, 0.9, 2), own), _box),
            (self.n_plants, lambda own: round_corners((0.0, 0.0), own.uniform(0.2, 0.35)), _plant),
        )
        for count, outline, draw in things:
            put = functools.partial(draw, plan)
            plan.put(rng, (low, high), count, outline, put, clearance_m=_OFF_TOUR_M)
        return self.finish(plan, "clutter", rng)

    def _table(self, plan: Plan, corners: Array, rng: np.random.Generator) -> None:
        """A table on four square legs in the middle of an outline, and chairs pushed in askew."""
        centre = corners.mean(axis=0)
        yaw = math.atan2(*(corners[1] - corners[0])[::-1])
        size = rng.uniform((0.7, 0.7), (1.1, 0.9))
        top = box_corners(centre, size, yaw)
        legs = centre + 0.9 * (top - centre)
        for number, leg in enumerate(legs):
            plan.prism(box_corners(leg, (0.05, 0.05), yaw), 0.0, _TABLE_M - 0.03, joined=number > 0)
        plan.prism(top, _TABLE_M - 0.03, _TABLE_M, joined=True)
        for side in rng.permutation(4)[: self.chairs_per_table]:
            out = yaw + side * math.pi / 2
            off = rng.uniform(0.5, 0.62) + 0.1
            _chair(plan, centre + off * np.array([math.cos(out), math.sin(out)]), out, rng)


def _chair(plan: Plan, spot: Array, yaw: float, rng: np.random.Generator) -> None:
    """A chair on four tubes, and its back."""
    turned = yaw + rng.uniform(-0.3, 0.3)
    feet = box_corners(spot, (0.36, 0.36), turned)
    for number, foot in enumerate(feet):
        plan.prism(round_corners(foot, 0.0125), 0.0, _SEAT_M, joined=number > 0)
    plan.prism(box_corners(spot, (0.4, 0.4), turned), _SEAT_M, _SEAT_M + 0.03, joined=True)


def _box(plan: Plan, corners: Array, rng: np.random.Generator) -> None:
    plan.prism(corners, 0.0, rng.uniform(0.4, 1.6))


def _plant(plan: Plan, corners: Array, rng: np.random.Generator) -> None:
    """A round pot, a stem and leaves."""
    centre = corners.mean(axis=0)
    radius = float(np.hypot(*(corners[0] - centre)))
    top = rng.uniform(0.3, 0.5)
    plan.prism(corners, 0.0, top)
    plan.prism(round_corners(centre, 0.02), top, top + 0.3, joined=True)
    plan.prism(round_corners(centre, 0.9 * radius), top + 0.3, top + 1.0, joined=True)


def _turned(size: Sequence[float] | Array, rng: np.random.Generator) -> Array:
    """Corners (4, 2) of a box about the origin, turned at random."""
    return box_corners((0.0, 0.0), size, rng.uniform(0.0, math.pi))


@options("world")
class Curved(FurnishedOptions):
    """A hall with bent walls, round pillars, curved screens and two round stairwells.

    Its long walls are arcs, bent outwards, and its corners are round. Nothing in it is straight but
    two short walls. The tour goes round both stairwells in a figure of eight.
    """

    length_m: Positive = 26.0
    width_m: Positive = 14.0
    bend_m: Positive = 1.5
    """How far the long walls bend outwards."""
    corner_m: Positive = 3.0
    """Radius of the corners."""
    stairwell_m: Positive = 1.6
    """Radius of the stairwells."""
    n_pillars: NonNegativeInt = 12
    min_pillar_m: Positive = 0.12
    """Radii of the pillars, from this to the next."""
    max_pillar_m: Positive = 0.45
    n_screens: NonNegativeInt = 4
    """Curved screens, 5 cm thick."""

    def __post_init__(self) -> None:
        require(
            self.min_pillar_m <= self.max_pillar_m,
            "world.min_pillar_m must not be above world.max_pillar_m",
        )
        check_margins(
            length_m=self.length_m / 4 - self.stairwell_m - self.corner_m - 0.2,
            width_m=self.width_m / 2 - self.stairwell_m - 2.4,
            corner_m=self.width_m / 2 - self.corner_m,
        )

    def build(self, rng: np.random.Generator) -> World:
        """Build the world."""
        plan, length, width = Plan(), self.length_m, self.width_m
        plan.enclosure(self._outline())
        plan.place("room", 0.0, 0.0, length, width)
        wells = [np.array([share * length, width / 2]) for share in (0.25, 0.75)]
        for well in wells:
            plan.prism(round_corners(well, self.stairwell_m), 0.0, 2.5, on_object=False)
        plan.tour = self._eight(wells)
        low, high = (0.3, 0.3), (length - 0.3, width - 0.3)
        radii = self.min_pillar_m, self.max_pillar_m
        plan.put(
            rng, (low, high), self.n_pillars,
            lambda own: round_corners((0.0, 0.0), own.uniform(*radii)),
            lambda corners, own: plan.prism(corners, 0.0, 2.5),
            clearance_m=_OFF_TOUR_M,
        )  # fmt: skip
        plan.put(
            rng, (low, high), self.n_screens, lambda own: _turned((1.8, 0.7), own),
            lambda corners, own: _screen(plan, corners), clearance_m=_OFF_TOUR_M,
        )  # fmt: skip
        return self.finish(plan, "curved", rng)

    def _outline(self) -> Array:
        """Corners (N, 2) of the hall, counter-clockwise."""
        length, width, r = self.length_m, self.width_m, self.corner_m
        half = length / 2 - r
        bow = (half**2 + self.bend_m**2) / (2.0 * self.bend_m)
        lean = math.asin(half / bow)
        quarter = math.pi / 2
        ring = np.concatenate([
            arc_points((length / 2, bow - self.bend_m), bow, (-quarter - lean, -quarter + lean)),
            arc_points((length - r, r), r, (-quarter, 0.0)),
            arc_points((length - r, width - r), r, (0.0, quarter)),
            arc_points((length / 2, width + self.bend_m - bow), bow,
                       (quarter - lean, quarter + lean)),
            arc_points((r, width - r), r, (quarter, 2 * quarter)),
            arc_points((r, r), r, (2 * quarter, 3 * quarter)),
        ])  # fmt: skip
        apart = np.hypot(*(ring - np.roll(ring, 1, axis=0)).T) > 1e-6
        return np.asarray(ring[apart])

    def _eight(self, wells: list[Array]) -> list[tuple[float, float]]:
        """Way round one stairwell and then, the other way, round the other."""
        r, middle = self.stairwell_m + 1.3, np.mean(wells, axis=0)
        first = arc_points(wells[0], r, (0.25 * math.pi, 1.75 * math.pi))[:: _every(r)]
        second = arc_points(wells[1], r, (1.25 * math.pi, 2.75 * math.pi))[:: _every(r)]
        # from the middle up and round the left, back through it, up and round the right
        path = [middle, *first, middle, *second, middle]
        return [(float(x), float(y)) for x, y in path]


def _every(radius_m: float) -> int:
    """Of the points on an arc, so many make about 20 degrees."""
    return max(round(math.radians(20.0) / arc_step_rad(radius_m)), 1)


def _screen(plan: Plan, corners: Array) -> None:
    """A curved screen within a box of 1.8 by 0.7 m: sixty degrees of a circle."""
    centre = corners.mean(axis=0)
    along = (corners[1] - corners[0]) / np.hypot(*(corners[1] - corners[0]))
    heading, radius = math.atan2(along[1], along[0]), 1.5
    hub = centre - (radius - 0.2) * np.array([-along[1], along[0]])
    ends = heading + math.pi / 2 + np.array([-1.0, 1.0]) * math.pi / 6
    outer = arc_points(hub, radius, ends.tolist())
    inner = arc_points(hub, radius - 0.05, ends[::-1].tolist())
    plan.prism(np.concatenate([outer, inner]), 0.0, 2.0)


class _Cabinet(NamedTuple):
    along_m: float
    width_m: float
    depth_m: float
    on_left: bool


@options("world")
class CorridorsAlike(FurnishedOptions):
    """Parallel corridors between two others, with the same cabinets at the same places.

    The tour goes through one after the other, and back along the side. A laser that sees one of
    them sees them all; how far the wheels have drifted by then differs, since the corridors lie at
    unequal distances.
    """

    n_corridors: Annotated[int, Field(ge=2, le=12)] = 4
    length_m: Positive = 20.0
    width_m: Positive = 2.2
    min_block_m: Positive = 3.0
    """Between two corridors, from this to the next."""
    max_block_m: Positive = 9.0
    n_cabinets: NonNegativeInt = 5
    """In each corridor."""
    differing_share: Share = 0.0
    """Of the cabinets, those that are each corridor's own."""

    def __post_init__(self) -> None:
        require(
            self.min_block_m <= self.max_block_m,
            "world.min_block_m must not be above world.max_block_m",
        )
        check_margins(length_m=self.length_m - 2.0 - self.n_cabinets, width_m=self.width_m - 1.9)

    def build(self, rng: np.random.Generator) -> World:
        """Build the world."""
        plan, w, length = Plan(), self.width_m, self.length_m
        blocks = rng.uniform(self.min_block_m, self.max_block_m, self.n_corridors - 1)
        feet = np.concatenate([[0.0], np.cumsum(blocks + w)])  # y of each corridor's south wall
        plan.rectangle((0.0, 0.0), (length + 2 * w, feet[-1] + w))
        for below, above in pairwise(feet):
            block = rectangle_corners((w, below + w), (w + length, above))
            plan.prism(block, 0.0, 2.5, on_object=False)
        common = [self._cabinet(i, rng) for i in range(self.n_cabinets)]
        for number, foot in enumerate(feet):
            plan.place(f"corridor_{number}", w + _CLOSE_M, foot, w + length - _CLOSE_M, foot + w)
            for i, cabinet in enumerate(common):
                own = self._cabinet(i, rng) if rng.random() < self.differing_share else cabinet
                _stand(plan, own, (w, float(foot)), w)
        west, east = w / 2, 1.5 * w + length
        plan.tour = [(west, w / 2)]
        for number, foot in enumerate(feet):
            ends = (west, east) if number % 2 == 0 else (east, west)
            plan.tour += [(x, float(foot) + w / 2) for x in ends]
        plan.tour = [*dict.fromkeys(plan.tour)]
        if plan.tour[-1][0] == east:
            plan.tour.append((west, plan.tour[-1][1]))
        plan.tour.append((west, w / 2))
        return self.finish(plan, "corridors_alike", rng)

    def _cabinet(self, number: int, rng: np.random.Generator) -> _Cabinet:
        pitch = (self.length_m - 2.0) / max(self.n_cabinets, 1)
        width = rng.uniform(0.3, 0.6) * min(pitch, 1.8)
        slack = (pitch - width) / 2 - 0.02
        along = 1.0 + (number + 0.5) * pitch + rng.uniform(-slack, slack)
        return _Cabinet(along, width, rng.uniform(0.2, 0.4), rng.random() < 0.5)


def _stand(plan: Plan, cabinet: _Cabinet, foot: tuple[float, float], corridor_m: float) -> None:
    """Put a cabinet against a long wall of a corridor whose south-west corner is `foot`."""
    off = cabinet.depth_m / 2 + 0.01
    across = corridor_m - off if cabinet.on_left else off
    centre = (foot[0] + cabinet.along_m, foot[1] + across)
    plan.prism(box_corners(centre, (cabinet.width_m, cabinet.depth_m), 0.0), 0.0, 1.8)


@options("world")
class Hall(FurnishedOptions):
    """A hall whose walls lie beyond the range of most lasers, with few things in its middle."""

    length_m: Positive = 260.0
    width_m: Positive = 220.0
    n_pillars: Count = 8
    """Round, of a radius of 0.4 m."""
    n_boxes: NonNegativeInt = 8
    """Racks and crates about the tour."""
    tour_length_m: Positive = 50.0
    """Sides of the tour, in the middle of the hall."""
    tour_width_m: Positive = 30.0
    around_m: NonNegative = 15.0
    """How far from the tour things stand."""

    def __post_init__(self) -> None:
        for along in ("length_m", "width_m"):
            room = getattr(self, along) - getattr(self, f"tour_{along}") - 2 * self.around_m
            check_margins(**{along: room})

    def build(self, rng: np.random.Generator) -> World:
        """Build the world."""
        plan, half = Plan(), np.array([self.tour_length_m, self.tour_width_m]) / 2
        middle = np.array([self.length_m, self.width_m]) / 2
        plan.rectangle((0.0, 0.0), (self.length_m, self.width_m))
        corners = rectangle_corners(middle - half, middle + half)
        plan.tour = [(float(x), float(y)) for x, y in (*corners, corners[0])]
        area = middle - half - self.around_m, middle + half + self.around_m
        plan.put(
            rng, area, self.n_pillars, lambda own: round_corners((0.0, 0.0), 0.4),
            lambda ring, own: plan.prism(ring, 0.0, 6.0), clearance_m=1.0,
        )  # fmt: skip
        plan.put(
            rng, area, self.n_boxes, lambda own: _turned(own.uniform(0.8, 3.0, 2), own),
            functools.partial(_box, plan), clearance_m=1.0,
        )  # fmt: skip
        return self.finish(plan, "hall", rng)


@options("world")
class Polygon(FurnishedOptions):
    """A building with slanted walls round a court of the same outline; with many sides, round."""

    n_sides: Annotated[int, Field(ge=3, le=1000)] = 7
    radius_m: Positive = 9.0
    """Of the corners, on average."""
    irregular_share: Annotated[float, Field(ge=0.0, le=0.3)] = 0.15
    """By which a corner may lie farther out or in, and by which part of a side it may be turned."""
    court_share: Annotated[float, Field(ge=0.0, le=0.5)] = 0.35
    """Size of the court in the middle; 0: there is none."""
    n_boxes: NonNegativeInt = 4
    n_pillars: NonNegativeInt = 3

    def __post_init__(self) -> None:
        low = 1.0 - self.irregular_share - self.court_share * (1.0 + self.irregular_share)
        check_margins(radius_m=self.radius_m * low * math.cos(math.pi / self.n_sides) - 1.5)

    def build(self, rng: np.random.Generator) -> World:
        """Build the world."""
        plan, share = Plan(), self.irregular_share
        angles = np.arange(self.n_sides) + rng.uniform(-share, share, self.n_sides)
        angles *= 2.0 * math.pi / self.n_sides
        radii = self.radius_m * (1.0 + rng.uniform(-share, share, self.n_sides))
        outline = radii[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        plan.enclosure(outline)
        if self.court_share:
            plan.prism(self.court_share * outline, 0.0, 2.5, on_object=False)
        between = (1.0 + self.court_share) / 2.0
        ring = between * outline[:: max(self.n_sides // 24, 1)]
        plan.tour = [(float(x), float(y)) for x, y in (*ring, ring[0])]
        area = outline.min(axis=0), outline.max(axis=0)
        for count, draw_outline in (
            (self.n_boxes, lambda own: _turned(own.uniform(0.3, 1.0, 2), own)),
            (self.n_pillars, lambda own: round_corners((0.0, 0.0), own.uniform(0.12, 0.3))),
        ):
            plan.put(
                rng, area, count, draw_outline, lambda corners, own: plan.prism(corners, 0.0, 2.5),
                clearance_m=_OFF_TOUR_M,
            )  # fmt: skip
        return self.finish(plan, "polygon", rng)
