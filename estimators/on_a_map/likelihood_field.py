"""The likelihood field of a map for a laser: how well each place explains the end of a beam.

A beam that ends at distance d from the nearest wall has the likelihood

    p(d) = exp(-d^2 / (2 sigma^2)) + exp(-max_loss)

but for a factor, looked up in a table over the floor. The table holds (log p(0) - log p(d)) / step
in whole numbers of 16 bits, so that it stays in the processor's cache and a scan is a sum of
integers.

The second term is what the map does not explain: people, furniture of another day, the unknown. It
bounds what a beam can lose, so beams that end short at a crowd do not outweigh those that end at
walls. It is a mixture of hits and random measurements (Thrun, Burgard, Fox 2005, Probabilistic
Robotics, sec. 6.4), but its size does not follow from the laser's greatest range, and it is the
same on either side of a wall: 1 / z_max where nothing is known (ibid.) is more than what free space
has, and draws beams, and the robot with them, to the far side of the walls.

On an occupancy grid d is the distance to the middle of the nearest occupied cell, and zero in such
a cell. Only free cells are floor.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from estimators.on_a_map.walls import Nearest, nearest_walls, walls_of
from sim import se2
from sim.arrays import Array, Floats, Ints
from sim.compiled import njit
from sim.errors import require
from sim.options import Positive, options
from sim.sensors import Laser
from sim.worlds.grid import FREE_BELOW, OCCUPIED_ABOVE, OccupancyGrid
from sim.worlds.world import World

_MOST = 65535  # of a table entry
_CLEARANCE_M = 0.15  # where a robot's centre can be
_MOST_CELLS = 50_000_000  # 100 MB


@dataclass(frozen=True)
class LikelihoodField:
    """A table over the floor.

    Attributes
    ----------
    table
        (rows, columns) uint16 of y and x; its rim stands for all that lies outside.
    origin_m
        (2,) corner of cell (0, 0) in map.
    cell_m
        Side of a cell.
    step
        Log likelihood of one count.
    free_cells
        Rows and columns (F, 2) of the cells where a robot can be: the largest connected floor off
        the walls. What is shut in, such as the inside of furniture, does not count, nor does what
        a grid does not know to be free.
    walls
        (W, 4) that the laser sees, m; points, on a grid.
    nearest
        (rows, columns) which of them is the nearest; -1 where none is near.
    """

    table: NDArray[np.uint16]
    origin_m: Array
    cell_m: float
    step: float
    free_cells: Ints
    walls: Array
    nearest: Nearest

    def holds(self, pose: Array) -> bool:
        """Whether a pose (3,) lies on the table, rather than off the map."""
        column, row = (np.asarray(pose[:2]) - self.origin_m) / self.cell_m
        rows, columns = self.table.shape
        return bool(0.0 <= row < rows and 0.0 <= column < columns)

    def draw(self, n: int, rng: np.random.Generator) -> Array:
        """Poses (n, 3), uniform over the free floor, one in each nth of it, and over all headings.

        Neighbours come in turn, so the processor's cache holds what their beams look up.
        """
        require(len(self.free_cells) > 0, "the map has no free cells in which to place particles")
        rows = (np.arange(n) + rng.random(n)) * (len(self.free_cells) / n)
        cells = self.free_cells[np.minimum(rows.astype(np.int64), len(self.free_cells) - 1)]
        places: Array = self.origin_m + (cells[:, ::-1] + rng.random((n, 2))) * self.cell_m
        return np.column_stack([places, rng.uniform(-math.pi, math.pi, n)])

    def log_likelihood(self, poses: Array, ends: Floats) -> Array:
        """Log likelihood (M,) of a scan at poses (M, 3), relative to all beams ending at walls.

        Parameters
        ----------
        ends
            (2, B) where the beams end in base_link, m, as from `beam_ends`.
        """
        if not np.isfinite(poses).all():  # compiled code would read beyond the table
            raise FloatingPointError("poses of particles are not finite")
        counts = np.empty(len(poses), np.int64)
        rows, columns = self.table.shape
        _look_up(
            np.ascontiguousarray(poses), ends, self.table.ravel(), rows, columns,
            self.origin_m, self.cell_m, counts,
        )  # fmt: skip
        return -self.step * counts.astype(np.float64)


@options("estimator")
class FieldOptions:
    """Options of the beam model (likelihood field)."""

    sigma_m: Positive = 0.1
    """Spread of beam ends about the walls, m: range noise, half a cell, and errors of the map."""
    max_loss: Positive = 2.0
    """Greatest loss in log likelihood of a beam that ends off the walls: at people, at furniture
    that the map lacks, where nothing is known. AMCL's z_rand of 0.1 makes it 4 to 7."""
    cell_m: Positive = 0.05
    """Side of a cell, m."""


def likelihood_field(
    known_map: World | OccupancyGrid, laser: Laser, believed: FieldOptions
) -> LikelihoodField:
    """Work out the field of a world's walls at the height of the laser, or of a grid.

    Parameters
    ----------
    known_map
        World or grid. A grid has no heights: it is taken to be of the laser's.

    Raises
    ------
    InputError
        If no wall is at that height, or the table would be too large.
    """
    walls, extent = walls_of(known_map, laser)
    cell_m, sigma_m = believed.cell_m, believed.sigma_m
    floor_p = math.exp(-believed.max_loss)
    # Beyond this distance hits are a thousandth of what the map does not explain
    reach_m = sigma_m * math.sqrt(2.0 * (believed.max_loss + math.log(1000.0)))
    reach_m = max(reach_m, 2.0 * _CLEARANCE_M)
    with np.errstate(over="ignore", invalid="ignore"):  # counted in floats, which do not wrap
        origin = np.floor((extent.min(axis=0) - reach_m) / cell_m) * cell_m - cell_m
        sides = np.ceil((extent.max(axis=0) + reach_m - origin) / cell_m) + 1.0
        n_cells = float(np.prod(sides))
    where = "the grid" if isinstance(known_map, OccupancyGrid) else f"world {known_map.name}"
    require(
        n_cells <= _MOST_CELLS,
        f"estimator.cell_m={cell_m} makes {n_cells:.3g} cells of {where}; make it larger",
    )
    columns, rows = sides.astype(int).tolist()
    distances, nearest = nearest_walls(walls, origin, cell_m, reach_m, rows, columns)
    p = np.exp(-0.5 * np.square(distances / sigma_m)) + floor_p
    floor = distances > _CLEARANCE_M
    if isinstance(known_map, OccupancyGrid):
        free, occupied = _states(known_map, origin, cell_m, rows, columns)
        p[occupied] = 1.0 + floor_p
        floor &= free
    else:
        margin = round(reach_m / cell_m) + 1
        within = np.zeros_like(floor)
        within[margin:-margin, margin:-margin] = True
        floor &= within  # the walls' rectangle
    step = math.log1p(1.0 / floor_p) / _MOST
    table = np.round((math.log1p(floor_p) - np.log(p)) / step).astype(np.uint16)
    return LikelihoodField(table, origin, cell_m, step, _largest(floor), walls, nearest)


def _states(
    grid: OccupancyGrid, origin: Array, cell_m: float, rows: int, columns: int
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Whether the middle of each of the table's cells (rows, columns) is free, and is occupied."""
    probability = np.empty((rows, columns), np.float32)
    middles = np.empty((columns, 2))
    middles[:, 0] = origin[0] + (np.arange(columns) + 0.5) * cell_m
    for row in range(rows):
        middles[:, 1] = origin[1] + (row + 0.5) * cell_m
        probability[row] = grid.at(middles)
    return probability < FREE_BELOW, probability > OCCUPIED_ABOVE


def _largest(floor: NDArray[np.bool_]) -> Ints:
    """Rows and columns (F, 2) of the cells of the largest connected floor."""
    labels, count = ndimage.label(floor)
    if count == 0:
        return np.zeros((0, 2), np.int64)
    largest = 1 + np.argmax(np.bincount(labels[floor], minlength=count + 1)[1:])
    return np.argwhere(labels == largest)


def beam_ends(
    ranges_m: Floats | Array, laser: Laser, n_beams: int, bearings_rad: Array | None = None
) -> Floats:
    """Where beams end in base_link, (2, B) m: `n_beams` evenly spaced ones, less those unseen.

    With `bearings_rad` (N,), those of a scan taken to one instant, in place of the laser's.

    Beams without a reading (NaN) are not counted; if none of the chosen ones saw anything, they are
    chosen among those that did.
    """
    require(
        len(ranges_m) == laser.n_beams,
        f"a scan of {len(ranges_m)} ranges from a laser of {laser.n_beams} beams",
    )
    ranges = np.asarray(ranges_m, float)
    seen = laser.returned(ranges)
    chosen = _spread(np.flatnonzero(~np.isnan(ranges)), n_beams)
    if not seen[chosen].any():
        chosen = _spread(np.flatnonzero(seen), n_beams)
    chosen = chosen[seen[chosen]]
    bearings = (laser.bearings_rad if bearings_rad is None else bearings_rad)[chosen]
    rays = np.column_stack([np.cos(bearings), np.sin(bearings)])
    ends = se2.transform(laser.mount.pose, rays * ranges[chosen, None])
    return np.ascontiguousarray(ends.T, dtype=np.float32)


def _spread(places: Ints, max_particles: int) -> Ints:
    """At most `max_particles` of the places, evenly spaced."""
    n = min(max_particles, len(places))
    return places[((np.arange(n) + 0.5) * (len(places) / max(n, 1))).astype(np.int64)]


@njit(fastmath=True)
def _look_up(
    poses: Array,
    ends: Floats,
    table: NDArray[np.uint16],
    rows: int,
    columns: int,
    origin: Array,
    cell_m: float,
    counts: Ints,
) -> None:
    """Sum the table over the beam ends (2, B), for every pose (M, 3).

    In two passes a particle: the cells, which the compiler turns into vector instructions, then
    the look-ups. Unsigned indices need no test for counting from the end, and four sums let the
    processor wait for several look-ups at a time.
    """
    n = ends.shape[1]
    whole = n // 4 * 4
    x_ends, y_ends = ends[0], ends[1]
    cells = np.empty(n, np.uint32)
    zero, x_most, y_most = np.float32(0.0), np.float32(columns - 1), np.float32(rows - 1)
    stride = np.int32(columns)
    for m in range(len(poses)):
        cos = np.float32(math.cos(poses[m, 2]) / cell_m)
        sin = np.float32(math.sin(poses[m, 2]) / cell_m)
        x0 = np.float32((poses[m, 0] - origin[0]) / cell_m)
        y0 = np.float32((poses[m, 1] - origin[1]) / cell_m)
        for b in range(n):
            x = min(max(x0 + cos * x_ends[b] - sin * y_ends[b], zero), x_most)
            y = min(max(y0 + sin * x_ends[b] + cos * y_ends[b], zero), y_most)
            cells[b] = np.uint32(np.int32(y) * stride + np.int32(x))
        first = second = third = fourth = np.uint64(0)
        for b in range(0, whole, 4):
            first += table[cells[b]]
            second += table[cells[b + 1]]
            third += table[cells[b + 2]]
            fourth += table[cells[b + 3]]
        for b in range(whole, n):
            first += table[cells[b]]
        counts[m] = first + second + third + fourth
