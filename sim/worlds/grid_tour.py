"""A tour through a building of which there is only a grid."""

import numpy as np
import scipy

from sim.arrays import Array
from sim.errors import require
from sim.routes.frontiers import Ways, clearance
from sim.worlds.grid import OccupancyGrid

_CLEAR_M = 0.55  # of what is not known to be free
_SPACING_M = 0.6  # between points of the tour


def plan_tour(grid: OccupancyGrid, stops: int, rng: np.random.Generator) -> Array:
    """Plan a closed tour (P, 2) m that leads, always to the nearest, to places drawn at random.

    They lie in the largest part of the free space that is wide enough.

    Raises
    ------
    InputError
        If there are fewer places.
    """
    wide = clearance(~grid.free) * grid.resolution_m >= _CLEAR_M
    parts, _ = scipy.ndimage.label(wide, np.ones((3, 3)))
    sizes = np.bincount(parts.ravel())[1:]
    require(
        len(sizes) > 0 and sizes.max() >= stops,
        "world.stops: the grid's free space is too narrow for a tour; give world.waypoints",
    )
    passable = parts == 1 + int(np.argmax(sizes))
    cells = np.argwhere(passable)
    left = cells[rng.choice(len(cells), stops, replace=False)]
    first, way = left[0], left[:1]
    left = left[1:]
    while True:
        ways = Ways.over(passable, way[-1:])
        if not len(left):
            break
        nearest = int(np.argmin(ways.cost[0, left[:, 0], left[:, 1]]))
        way = np.vstack([way, ways.to(0, left[nearest])[1:]])
        left = np.delete(left, nearest, axis=0)
    way = np.vstack([way, ways.to(0, first)[1:]])
    every = max(round(_SPACING_M / grid.resolution_m), 1)
    return grid.middles_m(np.vstack([way[:-1:every], first]))
