"""Where a growing map ends: frontiers, what can be seen from them, and the ways to them.

A frontier is a free cell beside an unknown one (Yamauchi, "A frontier-based approach for autonomous
exploration", 1997). Cells are given by row and column.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy

from sim.arrays import Array, Bools, Ints
from sim.compiled import njit

Mask = Bools

_N_RAYS = 120  # that look for unknown cells
_ALONG = 0.5  # step along them, in cells


def frontiers(free: Mask, unknown: Mask, least_cells: int) -> list[Ints]:
    """Cells (N, 2) of each connected frontier of at least so many cells."""
    labels, n = scipy.ndimage.label(free & adjacent(unknown), np.ones((3, 3)))
    groups = [np.argwhere(labels[box] == k + 1) + [part.start for part in box]
              for k, box in enumerate(scipy.ndimage.find_objects(labels, n))]  # fmt: skip
    return [cells for cells in groups if len(cells) >= least_cells]


def adjacent(mask: Mask) -> Mask:
    """Cells of a mask, and those that share a side with one."""
    return np.asarray(scipy.ndimage.binary_dilation(mask))


def clearance(occupied: Mask) -> Array:
    """Distance of each cell to the nearest occupied one, in cells; inf if there is none."""
    if not occupied.any():
        return np.full(occupied.shape, np.inf)
    return np.asarray(scipy.ndimage.distance_transform_edt(~occupied))


def disc(shape: tuple[int, ...], at: Ints, radius: float) -> Mask:
    """Cells within a radius of one (2,)."""
    rows, columns = np.ogrid[: shape[0], : shape[1]]
    return np.asarray((rows - at[0]) ** 2 + (columns - at[1]) ** 2 <= radius**2)


def middle_of(cells: Ints) -> Ints:
    """Of cells (N, 2), the one (2,) nearest to their mean."""
    return np.asarray(cells[np.argmin(np.sum((cells - cells.mean(axis=0)) ** 2, axis=1))])


@njit()
def _look(
    occupied: Mask, unknown: Mask, counted: Mask, at: Ints, angle_rad: float, reach: float
) -> tuple[float, int]:
    """Distance to an occupied cell along a ray, at most `reach`, and unknown cells not yet counted.

    Distances are in cells.
    """
    rows, columns = occupied.shape
    n = 0
    for k in range(int(reach / _ALONG) + 1):
        row = round(at[0] + _ALONG * k * math.sin(angle_rad))
        column = round(at[1] + _ALONG * k * math.cos(angle_rad))
        if not (0 <= row < rows and 0 <= column < columns) or occupied[row, column]:
            return _ALONG * k, n
        if unknown[row, column] and not counted[row, column]:
            counted[row, column] = True
            n += 1
    return reach, n


@njit()
def unknown_in_sight(occupied: Mask, unknown: Mask, at: Ints, reach: float) -> int:
    """How many unknown cells lie within `reach` cells of one (2,), and not behind occupied ones."""
    counted = np.zeros_like(unknown)
    n = 0
    for ray in range(_N_RAYS):
        angle = 2.0 * math.pi * ray / _N_RAYS
        n += _look(occupied, unknown, counted, at, angle, reach)[1]
    return n


def in_sight(occupied: Mask, at: Ints, others: Ints, reach: float) -> Array:
    """Chance (N,) that cells (N, 2) are seen from one (2,).

    It falls with the distance from 1 to 0 at `reach` cells, and is 0 behind occupied cells
    (Burgard, Moors, Stachniss, Schneider, "Coordinated multi-robot exploration", 2005).
    """
    off = others - at
    far = np.hypot(*off.T)
    none = np.zeros_like(occupied)
    angles = np.arctan2(off[:, 0], off[:, 1])
    clear = [
        _look(occupied, none, none, at, angle, distance)[0] >= distance
        for angle, distance in zip(angles.tolist(), np.minimum(far, reach).tolist(), strict=True)
    ]
    return np.where(clear, np.maximum(1.0 - far / reach, 0.0), 0.0)


@dataclass(frozen=True)
class Ways:
    """Shortest ways over the cells that a robot may enter, from where each robot is.

    Attributes
    ----------
    passable
        (rows, columns).
    cost
        (R, rows, columns) length in cells, inf where none leads.
    """

    passable: Mask
    cost: Array
    _cells: Ints
    _before: Ints

    @classmethod
    def over(cls, passable: Mask, starts: Ints) -> Ways:
        """From cells (R, 2), or the nearest ones that may be entered."""
        cells = np.argwhere(passable)
        numbers = np.full(passable.shape, -1)
        numbers[passable] = np.arange(len(cells))
        ends: list[tuple[Ints, Ints, float]] = []
        for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
            there = np.full_like(numbers, -1)
            columns = slice(None, -right or None) if right >= 0 else slice(1, None)
            shifted = slice(right, None) if right >= 0 else slice(None, right)
            there[: len(numbers) - down, columns] = numbers[down:, shifted]
            both = (numbers >= 0) & (there >= 0)
            ends.append((numbers[both], there[both], math.hypot(down, right)))
        first, second = (np.concatenate([each[k] for each in ends]) for k in (0, 1))
        lengths = np.concatenate([np.full(len(a), length) for a, _, length in ends])
        graph = scipy.sparse.csr_array((lengths, (first, second)), shape=(len(cells), len(cells)))
        near = nearest(passable, starts)
        found, before = scipy.sparse.csgraph.dijkstra(
            graph, directed=False, indices=numbers[*near.T], return_predecessors=True
        )
        cost = np.full((len(starts), *passable.shape), np.inf)
        cost[:, passable] = found
        return cls(passable, cost, cells, before)

    def to(self, robot: int, cell: Ints) -> Ints:
        """Cells (N, 2) of the way of a robot to a cell that it can reach."""
        at = int(np.count_nonzero(self.passable[: cell[0]]))
        at += int(np.count_nonzero(self.passable[cell[0], : cell[1]]))
        way = []
        while at >= 0:
            way.append(at)
            at = int(self._before[robot, at])
        return self._cells[way[::-1]]


def nearest(mask: Mask, cells: Ints) -> Ints:
    """For each of the cells (N, 2), the nearest (N, 2) that is in the mask."""
    indices = scipy.ndimage.distance_transform_edt(
        ~mask, return_distances=False, return_indices=True
    )
    return np.asarray(indices[:, cells[:, 0], cells[:, 1]].T)
