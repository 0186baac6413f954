"""Paths of a team in the world, and who saw whom."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from numpy.typing import NDArray

from experiments.evaluation.metrics import travelled_m
from experiments.viewing.style import BLACK, PURPLE, SERIES, plan_axes
from experiments.viewing.world import draw_walls
from sim.arrays import Array
from sim.recording import Recording
from sim.sensors import RobotCamera

_COLOURS = [colour for colour, _ in SERIES if colour not in (PURPLE, BLACK)]  # of landmarks, text


def colour_of(number: int) -> str:
    """Colour of a robot of a team."""
    return _COLOURS[number % len(_COLOURS)]


def path_width(number: int, size: int) -> float:
    """Width of a robot's path, points: each one narrower, so that none hides those below it."""
    return 1.0 + 1.2 * (size - number)


def sightings(robots: Sequence[Recording], number: int) -> tuple[Array, NDArray[np.float64]]:
    """Stamps (S,) s of a robot's sightings, and true lines (S, 2, 2) m, in map.

    A line goes from the robot to the one that it sees. Robots without truth have none.
    """
    own = robots[number]
    stamps, lines = [np.zeros(0)], [np.zeros((0, 2, 2))]
    for name, sensor in own.sensors.items():
        hidden = own.truth.readings.get(name) if own.truth else None
        if isinstance(sensor, RobotCamera) and hidden is not None and name in own.logs:
            log = own.logs[name]
            at = np.repeat(log.stamps, np.diff(log.known_splits))
            ends = np.full((len(at), 2), np.nan)
            for other, robot in enumerate(robots):
                seen = hidden["true_ids"] == other
                if robot.truth is not None:
                    ends[seen] = robot.truth_at(at[seen])[:, :2]
            stamps.append(at)
            lines.append(np.stack([own.truth_at(at)[:, :2], ends], axis=1))
    when, where = np.concatenate(stamps), np.concatenate(lines)
    known = np.isfinite(where).all(axis=(1, 2))
    return when[known], where[known]


def draw_sightings(ax: Axes, lines: Array, number: int) -> None:
    """Draw a robot's sightings (S, 2, 2), m, in map."""
    colour = colour_of(number)
    ax.add_collection(
        LineCollection(list(lines), colors=colour, lw=0.7, alpha=0.9, ls=(0, (4, 2)), zorder=3)
    )


def drive_of(robots: Sequence[Recording], until_m: float = math.inf) -> dict[str, Array]:
    """Arrays for `draw_paths`: the walls, and true paths until a distance driven, m."""
    world = robots[0].known_world
    arrays: dict[str, Array] = {"walls": world.walls, "wall_z_m": world.wall_z_m}
    for number, robot in enumerate(robots):
        poses = robot.known_truth.poses
        arrays[f"truth_{number}"] = poses[travelled_m(poses) <= until_m, :2]
    return arrays


def draw_paths(ax: Axes, run: Mapping[str, Array]) -> None:
    """Draw a world's walls, and the true paths of a team, which show where they lie on each other.

    Parameters
    ----------
    run
        Arrays: `walls`, `wall_z_m`, and of each robot `truth_N` (T, 2) m, in map.
    """
    draw_walls(ax, run["walls"], run["wall_z_m"])
    size = sum(name.startswith("truth_") for name in run)
    for number in range(size):
        path, colour = run[f"truth_{number}"], colour_of(number)
        ax.plot(
            *path.T, color=colour, alpha=0.5, lw=path_width(number, size), label=f"robot {number}"
        )
        ax.plot(*path[0], "o", color=colour, mec=BLACK, ms=8, zorder=4)
    ax.plot([], [], "o", color="white", mec=BLACK, ms=8, label="start")
    plan_axes(ax)
