"""OccupancyGrid: a map of square cells, each free, occupied or unknown, in the frame `map`."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import scipy

from sim import se2
from sim.arrays import Array, ArrayLike, Bools, Floats, Ints
from sim.errors import require
from sim.worlds.world import World

if TYPE_CHECKING:
    from sim.recording import Recording

MOST_CELLS = 50_000_000  # 200 MB
FREE_BELOW, OCCUPIED_ABOVE = 0.196, 0.65  # the thresholds that ROS's map server writes


@dataclass(frozen=True)
class OccupancyGrid:
    """A map of square cells.

    Attributes
    ----------
    probability
        (rows, columns) of y and x: probability that a cell is occupied, NaN where nothing is known.
    resolution_m
        Side of a cell.
    origin
        (3,) m, m, rad: pose in map of the corner of cell (0, 0); columns go along its x axis.
    """

    probability: Floats
    resolution_m: float
    origin: Array = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        require(
            self.probability.ndim == 2 and self.probability.size > 0,
            f"a grid has rows and columns, got shape {self.probability.shape}",
        )
        require(
            not np.any((self.probability < 0.0) | (self.probability > 1.0)),
            "a grid's probabilities lie in [0, 1], or are NaN where unknown",
        )
        require(
            1e-4 <= self.resolution_m <= 100.0,
            f"a grid's resolution must lie between 0.1 mm and 100 m, got {self.resolution_m}",
        )
        require(
            np.shape(self.origin) == (3,) and np.all(np.abs(self.origin) <= 1e7),
            f"a grid's origin is x, y, yaw, within 10,000 km of map's, got {self.origin}",
        )

    @property
    def free(self) -> Bools:
        """(rows, columns): where nothing stands."""
        return self.probability < FREE_BELOW

    @property
    def occupied(self) -> Bools:
        """(rows, columns): where something stands. What is neither free nor this is unknown."""
        return self.probability > OCCUPIED_ABOVE

    @property
    def corners_m(self) -> Array:
        """(4, 2) m: the grid's corners in map, counter-clockwise from the origin."""
        rows, columns = self.probability.shape
        steps = np.array([[0, 0], [columns, 0], [columns, rows], [0, rows]])
        return se2.transform(self.origin, self.resolution_m * steps)

    def middles_m(self, cells: Ints) -> Array:
        """Middles (N, 2) m in map of cells (N, 2), given by row and column."""
        return se2.transform(self.origin, self.resolution_m * (cells[:, ::-1] + 0.5))

    def at(self, points_in_map: ArrayLike) -> Floats:
        """Probability (N,) at points (N, 2) m; NaN where nothing is known, and off the grid."""
        places = se2.transform(se2.inverse(self.origin), points_in_map) / self.resolution_m
        rows, columns = self.probability.shape
        inside = np.all((places >= 0.0) & (places < [columns, rows]), axis=1)
        found = np.full(len(places), np.nan, np.float32)
        column, row = places[inside].astype(np.int64).T
        found[inside] = self.probability[row, column]
        return found

    def moved(self, T_new_old: ArrayLike) -> OccupancyGrid:
        """Return the grid as seen from another map frame."""
        return dataclasses.replace(self, origin=se2.compose(T_new_old, self.origin))

    def walls(self) -> Array:
        """Borders (W, 4) m in map of the occupied cells: x1, y1, x2, y2 of straight runs."""
        solid = np.pad(self.occupied, 1)
        row, left, right = _runs(solid[1:, 1:-1] != solid[:-1, 1:-1])
        column, low, high = _runs((solid[1:-1, 1:] != solid[1:-1, :-1]).T)
        level = np.stack([left, row, right, row], axis=1)
        upright = np.stack([column, low, column, high], axis=1)
        ends = self.resolution_m * np.concatenate([level, upright]).reshape(-1, 2)
        return se2.transform(self.origin, ends).reshape(-1, 4)


def _runs(mask: Bools) -> tuple[Ints, Ints, Ints]:
    """Row, first column and column after the last of each run of True along the rows."""
    steps = np.diff(np.pad(mask.astype(np.int8), ((0, 0), (1, 1))), axis=1)
    row, first = np.nonzero(steps == 1)
    return row, first, np.nonzero(steps == -1)[1]


def check_size(rows: float, columns: float, what: str, remedy: str) -> None:
    """Refuse a grid of too many cells before memory is taken for it."""
    require(
        rows * columns <= MOST_CELLS,
        f"{what}: {columns:.0f} x {rows:.0f} cells; at most {MOST_CELLS} allowed; {remedy}",
    )


def of_world(recording: Recording, resolution_m: float, z_m: float) -> OccupancyGrid:
    """Grid of the walls of a recording's world, for `prior.map`; see `rasterized`."""
    return rasterize(recording.known_world.known, resolution_m, z_m)


def rasterize(world: World, resolution_m: float, z_m: float) -> OccupancyGrid:
    """Grid of a world's walls at a height z_m, with a margin of two cells.

    Occupied is every cell within a quarter of a cell of a wall: a wall near a border takes the
    cells on both sides, so that their middle is off by a quarter of a cell at most. Free is what
    can be reached from the start pose and the way-points, or of a map without them the largest
    floor; the rest, such as what lies outside or inside furniture, is unknown.

    Raises
    ------
    InputError
        If no wall stands at that height, nothing can be reached, or there are too many cells.
    """
    require(
        math.isfinite(resolution_m) and resolution_m > 0.0,
        f"resolution_m must be a positive number, got {resolution_m}",
    )
    low, high = world.wall_z_m.T
    walls = world.walls[(low <= z_m) & (z_m <= high)]
    require(len(walls) > 0, f"world {world.name} has no wall at a height of {z_m} m")
    ends = walls.reshape(-1, 2)
    corner = (np.floor(ends.min(axis=0) / resolution_m) - 2.0) * resolution_m
    columns, rows = np.ceil((ends.max(axis=0) - corner) / resolution_m) + 2.0
    check_size(rows, columns, f"world {world.name}", "make resolution_m larger")
    occupied = mark_walls(walls, corner, resolution_m, (int(rows), int(columns)))
    floors, _ = scipy.ndimage.label(~occupied)
    starts = np.concatenate([world.start_pose[None, :2], world.waypoints])
    places = np.floor((starts - corner) / resolution_m).astype(np.int64)
    places = places[np.all((places >= 0) & (places < [columns, rows]), axis=1)]
    reached = np.setdiff1d(floors[places[:, 1], places[:, 0]], [0])
    if not starts.any():
        reached = np.array([1 + np.argmax(np.bincount(floors.ravel())[1:])])
    require(
        len(reached) > 0, f"world {world.name}: start pose and way-points lie in walls or outside"
    )
    probability = np.full(occupied.shape, np.nan, np.float32)
    probability[np.isin(floors, reached)] = 0.0
    probability[occupied] = 1.0
    return OccupancyGrid(probability, resolution_m, np.array([*corner, 0.0]))


def mark_walls(walls: Array, corner: Array, resolution_m: float, shape: tuple[int, int]) -> Bools:
    """Cells (rows, columns) within a quarter of a cell of walls (W, 4) m; `corner` is theirs."""
    occupied = np.zeros(shape, bool)
    for x1, y1, x2, y2 in walls:
        steps = math.ceil(8.0 * math.hypot(x2 - x1, y2 - y1) / resolution_m)
        on_wall = np.linspace((x1, y1), (x2, y2), steps + 1) - corner
        for beside in np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]]) / 4.0:
            column, row = (on_wall / resolution_m + beside).astype(np.int64).T
            occupied[row, column] = True
    return occupied
