"""An occupancy grid from laser scans at known poses: log odds, ray by ray.

Each scan adds to a cell's log odds once (Moravec and Elfes 1985; Thrun, Burgard, Fox 2005,
Probabilistic Robotics, ch. 9):

    l <- l + log(p / (1 - p)),

with p = `p_hit` where one of its beams ends, else `p_miss` where one passes. So beams that graze a
wall do not clear the cells that their neighbours hit. Nothing bounds the sum, as the world does not
change: a wall that was seen well outlasts a few scans from a pose in error. A cell that no beam has
touched is unknown, and so is all that a beam without a return may have crossed.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from sim import se2
from sim.arrays import Array, Floats, Ints
from sim.compiled import njit
from sim.errors import require
from sim.sensors.laser import Laser
from sim.worlds.grid import OccupancyGrid, check_size

P_HIT, P_MISS = 0.8, 0.4
_AT_ONCE = 50  # scans


def map_scans(
    poses: Array,
    ranges_m: Floats,
    laser: Laser,
    *,
    resolution_m: float,
    max_range_m: float | None = None,
    p_hit: float = P_HIT,
    p_miss: float = P_MISS,
    on_progress: Callable[[int], None] | None = None,
) -> OccupancyGrid:
    """Build a grid from scans.

    Parameters
    ----------
    poses
        (N, 3) m, m, rad: base_link in map at each scan; finite.
    ranges_m
        (N, beams), m; what is not finite, or not within the laser's ranges, says nothing.
    resolution_m
        Side of a cell.
    max_range_m
        Longer beams clear the cells up to here, and hit nothing; None for the laser's range.
    p_hit, p_miss
        Probability that a cell is occupied if a beam ends in it, or passes through it. With these a
        cell ends up occupied if a quarter of the scans hit it, GMapping's share.
    on_progress
        Called with the number of scans done.

    Raises
    ------
    InputError
        If no beam has a return, or the grid would be too large.
    """
    require(
        math.isfinite(resolution_m) and resolution_m > 0.0,
        f"the resolution must be a positive number, got {resolution_m}",
    )
    most_m = laser.max_range_m if max_range_m is None else max_range_m
    require(most_m > 0.0, f"the greatest range must be a positive number, got {most_m}")
    lasers = se2.compose(poses, laser.mount.pose)
    bearings = laser.bearings_rad
    seen = laser.returned(ranges_m)
    require(seen.any(), "no scan has a return, so there is nothing to map")
    ranges = np.where(seen, ranges_m, np.float32(0.0)).astype(np.float32)
    low, high = _bounds(lasers, ranges, bearings, most_m)
    corner = np.floor(low / resolution_m) - 1.0  # whole cells, so that maps of a place agree
    columns, rows = np.floor(high / resolution_m) - corner + 2.0
    check_size(
        rows, columns, "the map", "check that the estimate has not diverged, or take larger cells"
    )
    grid = ScanGrid(corner, (int(rows), int(columns)), resolution_m, p_hit, p_miss)
    for begin in range(0, len(lasers), _AT_ONCE):
        part = slice(begin, begin + _AT_ONCE)
        grid.add(lasers[part], ranges[part], bearings, most_m)
        if on_progress is not None:
            on_progress(grid.n_scans)
    return grid.occupancy()


class ScanGrid:
    """A grid to which scans are added.

    Parameters
    ----------
    corner
        (2,) x, y of cell (0, 0), in whole cells from the origin of map.
    shape
        Rows and columns.
    resolution_m
        Side of a cell.
    p_hit, p_miss
        As in `map_scans`.

    Attributes
    ----------
    log_odds
        (rows, columns) that a cell is occupied.
    last_scan
        (rows, columns) number of the last scan that touched each cell, from 1; 0 for none.
    n_scans
        Scans so far.
    """

    def __init__(
        self,
        corner: Array,
        shape: tuple[int, int],
        resolution_m: float,
        p_hit: float = P_HIT,
        p_miss: float = P_MISS,
    ) -> None:
        self.log_odds = np.zeros(shape, np.float32)
        self.last_scan = np.zeros(shape, np.int32)
        self.resolution_m, self.n_scans = resolution_m, 0
        self._corner = corner
        self._hit, self._miss = math.log(p_hit / (1.0 - p_hit)), math.log(p_miss / (1.0 - p_miss))

    @classmethod
    def over(cls, low: Array, high: Array, resolution_m: float) -> ScanGrid:
        """Grid over a rectangle with the corners (2,), (2,) m.

        Raises
        ------
        InputError
            If it would be too large.
        """
        corner = np.floor(low / resolution_m)
        columns, rows = np.ceil(high / resolution_m) - corner
        check_size(rows, columns, "the grid", "take larger cells")
        return cls(corner, (int(rows), int(columns)), resolution_m)

    def add(self, lasers: Array, ranges_m: Floats, bearings: Array, most_m: float) -> None:
        """Add scans; all that they touch must lie on the grid.

        Parameters
        ----------
        lasers
            (N, 3) poses in map.
        ranges_m
            (N, beams) float32; 0 for a beam that says nothing. Those beyond `most_m` clear the
            cells up to there.
        bearings
            (beams,) rad.
        """
        eyes = np.column_stack([lasers[:, :2] / self.resolution_m - self._corner, lasers[:, 2]])
        _add_scans(
            self.log_odds, self.last_scan, eyes, ranges_m, bearings, (self.resolution_m, most_m),
            (self._hit, self._miss), self.n_scans,
        )  # fmt: skip
        self.n_scans += len(eyes)

    def cells(self, points: Array) -> Ints:
        """Cells (N, 2) of points (N, 2 or more) m, by row and column."""
        at: Ints = np.floor(points[:, 1::-1] / self.resolution_m - self._corner[::-1]).astype(int)
        return at

    def middles_m(self, cells: Ints) -> Array:
        """Middles (N, 2) m of cells (N, 2)."""
        return np.asarray((cells[:, ::-1] + 0.5 + self._corner) * self.resolution_m)

    def occupancy(self) -> OccupancyGrid:
        """The grid as a map; what no beam has touched is unknown."""
        probability = np.where(self.last_scan > 0, expit(self.log_odds), np.float32(np.nan))
        origin = np.array([*(self._corner * self.resolution_m), 0.0])
        return OccupancyGrid(probability.astype(np.float32), self.resolution_m, origin)


@njit()
def _bounds(lasers: Array, ranges: Floats, bearings: Array, most_m: float) -> tuple[Array, Array]:
    """Least and greatest x, y (2,) m of the lasers (N, 3) and of what they see."""
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for s in range(len(lasers)):
        for b in range(len(bearings)):
            r = min(ranges[s, b], most_m)
            angle = lasers[s, 2] + bearings[b]
            x, y = lasers[s, 0] + r * math.cos(angle), lasers[s, 1] + r * math.sin(angle)
            low[0], high[0] = min(low[0], x), max(high[0], x)
            low[1], high[1] = min(low[1], y), max(high[1], y)
    for s in range(len(lasers)):
        for i in range(2):
            low[i], high[i] = min(low[i], lasers[s, i]), max(high[i], lasers[s, i])
    return low, high


@njit()
def _between(start: Array, end: Array, cells: Ints) -> int:
    """Put the cells (row, column) from one point (x, y, in cells) to another into `cells`.

    From border to border (Amanatides and Woo 1987); returns their number.
    """
    x, y = start[0], start[1]
    dx, dy = end[0] - x, end[1] - y
    row, column = int(y), int(x)
    n = 1 + abs(int(end[1]) - row) + abs(int(end[0]) - column)
    right, up = (1 if dx > 0.0 else -1), (1 if dy > 0.0 else -1)
    # Share of the way to the next border, and from border to border
    per_x = abs(1.0 / dx) if dx != 0.0 else np.inf
    per_y = abs(1.0 / dy) if dy != 0.0 else np.inf
    t_x = per_x * (column + 1 - x if right > 0 else x - column) if dx != 0.0 else np.inf
    t_y = per_y * (row + 1 - y if up > 0 else y - row) if dy != 0.0 else np.inf
    for k in range(n):
        cells[k, 0], cells[k, 1] = row, column
        if t_x < t_y:
            t_x += per_x
            column += right
        else:
            t_y += per_y
            row += up
    return n


@njit()
def _add_scans(
    log_odds: Floats,
    last_scan: NDArray[np.int32],
    eyes: Array,
    ranges: Floats,
    bearings: Array,
    lengths_m: tuple[float, float],
    odds: tuple[float, float],
    begun: int,
) -> None:
    """Add scans to the grid (rows, columns), in place.

    Parameters
    ----------
    last_scan
        Number of the last scan that touched each cell, from 1; 0 for none.
    eyes
        (N, 3): where the lasers are, in cells from the grid's corner, and their headings.
    ranges
        (N, beams) m; 0 for a beam that says nothing.
    lengths_m
        Side of a cell, and the greatest range.
    odds
        Log odds that a cell gains where a beam ends, and where one passes.
    begun
        Number of scans already there.
    """
    (cell_m, most_m), (hit, miss) = lengths_m, odds
    ends = np.empty((len(bearings), 2))
    cells = np.empty((log_odds.shape[0] + log_odds.shape[1] + 2, 2), np.int64)
    for s in range(len(eyes)):
        number = begun + s + 1
        for b in range(len(bearings)):
            r = min(ranges[s, b], most_m) / cell_m
            angle = eyes[s, 2] + bearings[b]
            ends[b, 0] = eyes[s, 0] + r * math.cos(angle)
            ends[b, 1] = eyes[s, 1] + r * math.sin(angle)
            if 0.0 < ranges[s, b] <= most_m:
                row, column = int(ends[b, 1]), int(ends[b, 0])
                if last_scan[row, column] != number:
                    last_scan[row, column] = number
                    log_odds[row, column] += hit
        for b in range(len(bearings)):
            if ranges[s, b] > 0.0:
                for k in range(_between(eyes[s], ends[b], cells)):
                    row, column = cells[k, 0], cells[k, 1]
                    if last_scan[row, column] != number:
                        last_scan[row, column] = number
                        log_odds[row, column] += miss
