"""The walls of a known map at the height of a laser, and the nearest of them to each place."""

import math

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sim.arrays import Array
from sim.compiled import njit
from sim.errors import require
from sim.sensors import Laser
from sim.worlds.grid import OccupancyGrid
from sim.worlds.world import World

Nearest = NDArray[np.int32]


def walls_of(known_map: World | OccupancyGrid, laser: Laser) -> tuple[Array, Array]:
    """Walls (W, 4) that the laser sees, m, and points (N, 2) that span the map.

    Of a grid the walls are points: the middles of the occupied cells that have others beside them.

    Raises
    ------
    InputError
        If no wall is at the height of the laser.
    """
    if isinstance(known_map, OccupancyGrid):
        occupied = known_map.occupied
        middles = known_map.middles_m(np.argwhere(occupied & ~ndimage.binary_erosion(occupied)))
        require(len(middles) > 0, "the grid of prior.map has no occupied cell")
        return np.hstack([middles, middles]), known_map.corners_m
    low, high = known_map.wall_z_m[:, 0], known_map.wall_z_m[:, 1]
    walls = known_map.walls[(low <= laser.mount.z_m) & (laser.mount.z_m <= high)]
    require(
        len(walls) > 0, f"world {known_map.name} has no wall at the laser's {laser.mount.z_m} m"
    )
    return walls, walls.reshape(-1, 2)


@njit()
def nearest_walls(
    walls: Array, origin: Array, cell_m: float, reach_m: float, rows: int, columns: int
) -> tuple[Array, Nearest]:
    """Nearest wall to the middle of each cell (rows, columns), within reach.

    Returns
    -------
    distances_m
        (rows, columns) inf beyond reach.
    nearest
        (rows, columns) its place among the walls (W, 4); -1 beyond reach.
    """
    squares = np.full((rows, columns), np.inf)
    nearest = np.full((rows, columns), -1, np.int32)
    for w in range(len(walls)):
        x1, y1 = walls[w, 0] - origin[0], walls[w, 1] - origin[1]
        dx, dy = walls[w, 2] - walls[w, 0], walls[w, 3] - walls[w, 1]
        length_square = dx * dx + dy * dy
        per_square = 1.0 / length_square if length_square > 0.0 else 0.0  # of a point
        first_row = max(int((min(y1, y1 + dy) - reach_m) / cell_m), 0)
        last_row = min(int((max(y1, y1 + dy) + reach_m) / cell_m) + 1, rows)
        first = max(int((min(x1, x1 + dx) - reach_m) / cell_m), 0)
        last = min(int((max(x1, x1 + dx) + reach_m) / cell_m) + 1, columns)
        for i in range(first_row, last_row):
            y = (i + 0.5) * cell_m - y1
            for j in range(first, last):
                x = (j + 0.5) * cell_m - x1
                share = min(max((x * dx + y * dy) * per_square, 0.0), 1.0)
                square = (x - share * dx) ** 2 + (y - share * dy) ** 2
                if square < squares[i, j]:
                    squares[i, j], nearest[i, j] = square, w
    for i in range(rows):
        for j in range(columns):
            d = math.sqrt(squares[i, j])
            squares[i, j] = d if d < reach_m else np.inf
            nearest[i, j] = nearest[i, j] if d < reach_m else -1
    return squares, nearest
