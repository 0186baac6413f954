"""Worlds of posts: an orchard of trunks without walls, and a warehouse of racks."""

from typing import Annotated

import numpy as np
from pydantic import Field, NonNegativeInt

from sim.options import NonNegative, Positive, Share, options
from sim.worlds.floor_plan import Plan, box_corners, check_margins, gaps_m, round_corners
from sim.worlds.furnished import FurnishedOptions
from sim.worlds.world import World

_CLEAR_M = 0.8  # of posts, from the tour
_POST_M = 0.1  # side of a rack's upright
_TOP_M = 4.0


@options("world")
class Orchard(FurnishedOptions):
    """Trunks in rows, and nothing else; with `jitter_m` of a metre and more, a forest."""

    n_rows: Annotated[int, Field(ge=4, le=200)] = 7
    n_trees: Annotated[int, Field(ge=3, le=200)] = 9
    """Trees of a row."""
    row_m: Positive = 4.0
    """From row to row."""
    tree_m: Positive = 3.0
    """From tree to tree."""
    jitter_m: NonNegative = 0.2
    """By how much a tree may stand off its place, each way."""
    missing_share: Share = 0.1
    min_trunk_m: Positive = 0.06
    """Radii of the trunks, from this to the next."""
    max_trunk_m: Positive = 0.18
    n_landmarks: NonNegativeInt = 0

    def __post_init__(self) -> None:
        check_margins(
            row_m=self.row_m / 2 - self.max_trunk_m - _CLEAR_M,
            max_trunk_m=self.max_trunk_m - self.min_trunk_m,
        )

    def build(self, rng: np.random.Generator) -> World:
        """Build the world; the tour goes up the second alley and down the last but one."""
        plan, top = Plan(), (self.n_trees - 0.5) * self.tree_m
        left, right = 1.5 * self.row_m, (self.n_rows - 2.5) * self.row_m
        plan.tour = [(left, -1.5), (left, top), (right, top), (right, -1.5), (left, -1.5)]
        legs = np.hstack([plan.tour[:-1], plan.tour[1:]])
        for row in range(self.n_rows):
            for number in range(self.n_trees):
                spot = np.array([row * self.row_m, number * self.tree_m])
                spot += rng.uniform(-self.jitter_m, self.jitter_m, 2)
                radius = rng.uniform(self.min_trunk_m, self.max_trunk_m)
                stands = rng.random() >= self.missing_share
                if stands and gaps_m(np.tile(spot, (1, 2)), legs).min() > radius + _CLEAR_M:
                    plan.prism(round_corners(spot, radius), 0.0, _TOP_M)
        return self.finish(plan, "orchard", rng)


@options("world")
class Warehouse(FurnishedOptions):
    """Racks in rows: square uprights at equal distances, with pallets in some of the bays."""

    n_racks: Annotated[int, Field(ge=2, le=100)] = 4
    n_bays: Annotated[int, Field(ge=1, le=200)] = 8
    """Bays of a rack."""
    bay_m: Positive = 1.4
    depth_m: Positive = 1.1
    """Of a rack."""
    aisle_m: Positive = 2.8
    """Between racks, and round them."""
    pallets_share: Share = 0.3
    """Of the bays that hold a pallet on the floor."""

    def __post_init__(self) -> None:
        check_margins(
            aisle_m=self.aisle_m - 2 * _CLEAR_M,
            bay_m=self.bay_m - 0.6,
            depth_m=self.depth_m - 0.6,
        )

    def build(self, rng: np.random.Generator) -> World:
        """Build the world; the tour winds through the aisles, and back."""
        plan, pitch, long = Plan(), self.aisle_m + self.depth_m, self.n_bays * self.bay_m
        size = (long + 2 * self.aisle_m, self.n_racks * pitch + self.aisle_m)
        plan.rectangle((0.0, 0.0), size)
        ends = [self.aisle_m / 2, size[0] - self.aisle_m / 2]
        for aisle in range(self.n_racks + 1):
            y = aisle * pitch + self.aisle_m / 2
            plan.tour += [(x, y) for x in ends]
            ends.reverse()
        for rack in range(self.n_racks):
            low = rack * pitch + self.aisle_m
            for post in range(self.n_bays + 1):
                for side in (0.0, self.depth_m):
                    centre = (self.aisle_m + post * self.bay_m, low + side)
                    plan.prism(box_corners(centre, (_POST_M, _POST_M), 0.0), 0.0, _TOP_M)
            for bay in np.flatnonzero(rng.random(self.n_bays) < self.pallets_share):
                middle = self.aisle_m + (bay + 0.5) * self.bay_m, low + self.depth_m / 2
                turn, share = rng.uniform(-0.05, 0.05), rng.uniform(0.6, 0.8, 2)
                pallet = share * (self.bay_m, self.depth_m)
                plan.prism(box_corners(middle, pallet, turn), 0.0, rng.uniform(0.5, 1.6))
        return self.finish(plan, "warehouse", rng)
