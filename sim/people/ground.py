"""Where a person may walk: how far each place lies from the walls, and the ways between places."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy

from sim.arrays import Array, Bools, Ints
from sim.errors import require
from sim.routes.frontiers import Ways, clearance, nearest
from sim.worlds.grid import mark_walls
from sim.worlds.world import World

_CELL_M = 0.05
_MAX_CELLS = 3_000_000  # of a larger world the cells are larger
_WAY_CELL_M = 0.2  # of the ways, about


@dataclass(frozen=True)
class Ground:
    """Cells of a world, and how far each is from the walls.

    Attributes
    ----------
    corner_m
        (2,) corner of cell (0, 0) in map.
    cell_m
        Side of a cell.
    clear_m
        (rows, columns): no wall is nearer to any point of the cell.
    passable
        (rows, columns) of cells `per_way` times as large: where ways lead.
    """

    corner_m: Array
    cell_m: float
    clear_m: Array
    passable: Bools
    per_way: int

    @classmethod
    def of(cls, world: World, height_m: float, radius_m: float) -> Ground:
        """Ground for discs of a radius, as high as this, within reach of the world's tour.

        Raises
        ------
        InputError
            If there is none.
        """
        ends = np.concatenate([world.bounds_m.reshape(2, 2), world.start_pose[None, :2]])
        low, high = ends.min(axis=0) - 1.0, ends.max(axis=0) + 1.0
        cell_m = max(_CELL_M, math.sqrt(float(np.prod(high - low)) / _MAX_CELLS))
        per_way = max(round(_WAY_CELL_M / cell_m), 1)
        columns, rows = (np.ceil((high - low) / (cell_m * per_way)) * per_way).astype(int)
        within = world.wall_z_m[:, 0] < height_m
        occupied = mark_walls(world.walls[within], low, cell_m, (int(rows), int(columns)))
        starts = np.concatenate([world.start_pose[None, :2], world.waypoints])
        cells = np.floor((starts - low) / cell_m).astype(np.int64)[:, ::-1]
        rooms, _ = scipy.ndimage.label(~occupied)
        inside = np.isin(rooms, np.setdiff1d(rooms[cells[:, 0], cells[:, 1]], [0]))
        # A wall lies anywhere in its cell, and a person anywhere in the own one
        clear_m = np.where(inside, cell_m * (clearance(occupied) - math.sqrt(2.0)), -1.0)
        coarse = clear_m.reshape(rows // per_way, per_way, columns // per_way, per_way)
        free = coarse.min(axis=(1, 3)) >= radius_m
        floors, _ = scipy.ndimage.label(free)
        near = nearest(free, cells // per_way) if free.any() else cells // per_way
        walked = np.isin(floors, np.setdiff1d(floors[near[:, 0], near[:, 1]], [0]))
        require(
            bool(walked.any()), f"world {world.name} has no room for people to walk; set people.n=0"
        )
        return cls(low, cell_m, clear_m, walked, per_way)

    def middles_m(self, cells: Ints) -> Array:
        """Centres (N, 2), m in map, of walkable cells (N, 2)."""
        return self.corner_m + self.cell_m * self.per_way * (cells[:, ::-1] + 0.5)

    def cell_of(self, point: Array) -> Ints:
        """Cell (1, 2) of the ways nearest to a point (2,)."""
        size = np.array(self.passable.shape) - 1
        place = np.floor((point - self.corner_m) / (self.cell_m * self.per_way)).astype(np.int64)
        return nearest(self.passable, np.clip(place[::-1], 0, size)[None])

    def way(self, ways: Ways, start: Array) -> Array:
        """Way (P, 2) m from a point (2,) to the place that `ways` lead from; empty if none does."""
        [cell] = self.cell_of(start)
        if not math.isfinite(ways.cost[0, *cell]):
            return np.zeros((0, 2))
        return self.middles_m(ways.to(0, cell))[::-1]
