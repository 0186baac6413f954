"""Occupancy grids from above."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.transforms import Affine2D
from numpy.typing import NDArray

from experiments.viewing.style import figure
from sim.worlds.grid import OccupancyGrid

_OCCUPIED, _FREE, _UNKNOWN = 0, 255, 222  # greys
UNKNOWN = 3 * (_UNKNOWN / 255,)  # of the axes, off the grid


def draw_grid(ax: Axes, grid: OccupancyGrid, **style: Any) -> None:
    """Draw a grid, in metres: free white, occupied dark, unknown light grey."""
    rows, columns = grid.probability.shape
    x, y, yaw = grid.origin
    in_map = Affine2D().scale(grid.resolution_m).rotate(yaw).translate(x, y) + ax.transData
    options: dict[str, Any] = {"zorder": 0, **style}
    ax.imshow(
        grid_picture(grid),
        origin="lower",
        extent=(0, columns, 0, rows),
        transform=in_map,
        **options,
    )
    ax.update_datalim(grid.corners_m)
    ax.set(xlabel="x, m", ylabel="y, m", aspect="equal")


def grid_picture(grid: OccupancyGrid) -> NDArray[np.uint8]:
    """The grid as a picture (H, W, 3) whose first row is its lowest."""
    greys = np.full(grid.probability.shape, _UNKNOWN, np.uint8)
    greys[grid.free], greys[grid.occupied] = _FREE, _OCCUPIED
    return np.repeat(greys[..., None], 3, axis=2)


def grid_figure(grid: OccupancyGrid, title: str) -> Figure:
    """One grid, with its size and what is known of it above."""
    low, high = grid.corners_m.min(axis=0), grid.corners_m.max(axis=0)
    width_m, height_m = high - low
    page = figure(9.0, float(np.clip(8.3 * height_m / width_m, 2.0, 8.3)) + 0.9)
    ax = page.subplots()
    draw_grid(ax, grid)
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), facecolor=UNKNOWN)
    ax.set_title(f"{title}: {describe_grid(grid)}", loc="left", fontsize="medium")
    return page


def describe_grid(grid: OccupancyGrid) -> str:
    """Size of a grid, and the shares of its cells, in words."""
    rows, columns = grid.probability.shape
    free, occupied = float(grid.free.mean()), float(grid.occupied.mean())
    return (
        f"{columns} x {rows} cells of {grid.resolution_m:g} m, {free:.1%} free, "
        f"{occupied:.1%} occupied, {max(0.0, 1.0 - free - occupied):.1%} unknown"
    )
