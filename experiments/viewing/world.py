"""Worlds from above."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from experiments.viewing.style import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    WALL,
    YELLOW,
    plan_axes,
    subplots,
)
from sim.arrays import Array
from sim.recording import Recording, Truth
from sim.worlds.world import World

_PLACES = {
    "room": SKY,
    "corridor_bare": YELLOW,
    "corridor_objects": GREEN,
    "corner": RED,
    "curve": ORANGE,
    "door": BLACK,
}
_LASER_HEIGHT_M = 0.25  # faces that begin above it are drawn faintly


def sees_landmarks(recording: Recording) -> bool:
    """Whether a sensor observes any number of things at once, as a camera does landmarks."""
    return any(log.splits is not None for log in recording.logs.values())


def drawable(recording: Recording) -> list[str]:
    """Sensors whose readings can be drawn: dots of scans, crosses of landmarks."""
    return [n for n in recording.logs if hasattr(recording.sensors[n], "points_in_base")]


def points_in_base(recording: Recording, name: str, row: int) -> Array:
    """Points (N, 2) in base_link of one reading of a drawable sensor."""
    sensor: Any = recording.sensors[name]
    points: Array = sensor.points_in_base(recording.logs[name].reading(row))
    return points[:, :2]


def draw_world(
    ax: Axes, world: World, *, landmarks: bool = True, places: bool = False, tour: bool = False
) -> None:
    """Draw walls, and on request landmarks, named places and the tour, in metres."""
    if places:
        for name, rectangles in world.places.items():
            style: Any = {"color": _PLACES.get(name, PURPLE), "alpha": 0.15, "lw": 0}
            for j, (x1, y1, x2, y2) in enumerate(rectangles):
                label = name.replace("_", ", ") if j == 0 else ""
                ax.add_patch(Rectangle((x1, y1), x2 - x1, y2 - y1, label=label, **style))
    if world.known is not world:
        draw_walls(ax, world.known.walls, world.known.wall_z_m, color=ORANGE, alpha=0.6)
    draw_walls(ax, world.walls, world.wall_z_m)
    if landmarks and len(world.landmarks):
        twin = world.look_alike if len(world.look_alike) else np.zeros(len(world.landmarks), bool)
        for mask, color, label in ((~twin, PURPLE, "landmark"), (twin, ORANGE, "look-alike")):
            if mask.any():
                ax.plot(*world.landmarks[mask, :2].T, ".", color=color, ms=2.5, label=label)
    if tour and len(world.waypoints):
        ax.plot(*world.waypoints.T, color=BLUE, lw=1.0, label="tour")
        ax.plot(*world.start_pose[:2], "o", color=BLUE, ms=4, label="start")


def draw_people(ax: Axes, truth: Truth) -> None:
    """Draw the tracks of people who walk about."""
    tracks = np.zeros((0, 0, 3)) if truth.people is None else truth.people
    for person in range(tracks.shape[1]):
        label = "people" if person == 0 else ""
        ax.plot(*tracks[:, person, :2].T, color=SKY, lw=0.6, alpha=0.7, label=label)


def draw_walls(ax: Axes, walls: Array, wall_z_m: Array, **style: Any) -> None:
    """Draw walls (W, 4) whose faces stand between two heights (W, 2), and axes in metres."""
    high = wall_z_m[:, 0] > _LASER_HEIGHT_M
    for rows, usual in ((~high, {"color": WALL}), (high, {"color": GREEN, "alpha": 0.5})):
        lines = list(walls[rows].reshape(-1, 2, 2))
        ax.add_collection(LineCollection(lines, **{"lw": 0.9, **usual, **style}))
    plan_axes(ax)
    ax.autoscale_view()


def world_figure(world: World) -> Figure:
    """One world with everything in it, and a legend above."""
    x1, y1, x2, y2 = world.bounds_m
    # The map's own height beside the labels, and room above it for title and legend
    page, ax = subplots(9.0, float(np.clip(8.3 * (y2 - y1) / max(x2 - x1, 1.0), 2.0, 8.3)) + 1.5)
    draw_world(ax, world, places=True, tour=True)
    ax.set_title(world.name, loc="left")
    if ax.get_legend_handles_labels()[1]:
        page.legend(loc="outside upper right", ncols=5)
    return page
