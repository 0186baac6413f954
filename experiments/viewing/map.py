"""Occupancy grids from the scans of a recording, along its truth or any estimate of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from experiments.evaluation.time_sync import interpolate
from experiments.runs.console import progress, read_log
from experiments.viewing.estimates import check_no_overrides, estimate_along
from experiments.viewing.grid import describe_grid
from sim.arrays import Array
from sim.errors import require, required
from sim.recording import Recording
from sim.sensors import Laser
from sim.worlds.grid import OccupancyGrid
from sim.worlds.grid_file import check_name, write_grid
from sim.worlds.grid_mapping import map_scans

_LONGEST_GAP_S = 3.0  # between poses; scans in longer ones are left out


def path_of(
    recording: Recording, source: str, overrides: Sequence[str], on_step: Callable[[int], None]
) -> tuple[Array, Array]:
    """Stamps (T,) s and poses (T, 3) m, m, rad in map, to build a grid along.

    Parameters
    ----------
    source
        `truth`, or what `viewing.estimates.estimate_along` takes.
    overrides
        Hydra overrides for an estimator that runs now.
    on_step
        Called with the number of Frames done.
    """
    if source == "truth":
        check_no_overrides(overrides)
        truth = required(recording.truth, "this recording has no truth; name an estimator")
        return truth.stamps, truth.poses
    found = estimate_along(recording, source, overrides, on_step)
    sound = np.isfinite(found.means).all(axis=1)
    return found.stamps[sound], found.means[sound]


@dataclass(frozen=True)
class Gridding:
    """How a grid is built.

    Attributes
    ----------
    resolution_m
        Side of a cell, m.
    max_range_m
        Beams longer than this only clear cells, m; None: the laser's range.
    laser
        Name of the laser in the recording.
    raw
        Whether the file keeps probabilities in percent, not three states.
    """

    resolution_m: float
    max_range_m: float | None
    laser: str
    raw: bool


def map_file(log: str, source: str, overrides: Sequence[str], out: Path, how: Gridding) -> str:
    """Build a grid from a log's scans along a path, write it, and say what it is.

    Parameters
    ----------
    source, overrides
        As for `path_of`.
    out
        File to write, .yaml; beside it .pgm.
    """
    check_name(out)
    require("=" not in log, f"{log}: name a recording first, such as run.npz")
    recording = read_log([Path(log)], by_flag=False)
    n_all = len(recording.log(how.laser).stamps)
    with progress(source, len(recording.frame_stamps)) as on_step:
        path = path_of(recording, source, overrides, on_step)
    with progress("mapping", n_all, "scans") as on_progress:
        grid, n_scans = grid_along(
            recording,
            *path,
            resolution_m=how.resolution_m,
            max_range_m=how.max_range_m,
            laser=how.laser,
            on_progress=on_progress,
        )
    write_grid(grid, out, "raw" if how.raw else "trinary")
    return f"{out}: {describe_grid(grid)}, from {n_scans} of {n_all} scans"


def grid_along(
    recording: Recording,
    stamps: Array,
    poses: Array,
    *,
    resolution_m: float,
    max_range_m: float | None = None,
    laser: str = "laser",
    on_progress: Callable[[int], None] | None = None,
) -> tuple[OccupancyGrid, int]:
    """Grid of the scans of one laser along a path, and the number of scans in it.

    Poses (T, 3) are interpolated at the scans' stamps; scans before the first, after the last or
    in gaps of more than 3 s are left out.
    """
    log, sensor = recording.log(laser), recording.sensor(laser, Laser)
    require(len(stamps) >= 2, "a map needs a path of two poses or more")
    at_scans = interpolate(stamps, poses, log.stamps, _LONGEST_GAP_S)
    placed = np.isfinite(at_scans).all(axis=1)
    require(placed.any(), "no scan lies within the time span of the path")
    grid = map_scans(
        at_scans[placed],
        log["ranges_m"][placed],
        sensor,
        resolution_m=resolution_m,
        max_range_m=max_range_m,
        on_progress=on_progress,
    )
    return grid, int(placed.sum())
