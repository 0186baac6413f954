"""Occupancy grids from the scans of a recording, along its truth or any estimate of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from estimators.base import Estimate
from experiments.evaluation.time_sync import interpolate
from experiments.runs.evaluate import run_over
from experiments.runs.seeds import stream
from experiments.viewing.view import experiment_over, is_file_of_estimate, read_estimate
from sim.arrays import Array, Floats
from sim.errors import InputError, require, required
from sim.recording import Recording
from sim.sensors import Laser
from sim.worlds.grid import OccupancyGrid
from sim.worlds.grid_mapping import map_scans

_LONGEST_GAP_S = 3.0  # between poses; scans in longer ones are left out


def laser_scans(recording: Recording, name: str = "laser") -> tuple[Array, Floats, Laser]:
    """Stamps (N,) s and ranges (N, beams) m of the scans, and their laser; InputError if none."""
    log = recording.log(name)
    return log.stamps, log["ranges_m"], recording.sensor(name, Laser)


def path_of(
    recording: Recording, source: str, overrides: Sequence[str], on_step: Callable[[int], None]
) -> tuple[Array, Array]:
    """Stamps (T,) s and poses (T, 3) m, m, rad in map, to build a grid along.

    Parameters
    ----------
    source
        `truth`; an estimate.csv or its folder; or the name of an estimator to run over the
        recording, whose revised path is taken if it has one.
    overrides
        Hydra overrides for that estimator.
    on_step
        Called with the number of Frames done.
    """
    file = Path(source)
    if overrides and (source == "truth" or is_file_of_estimate(file)):
        raise InputError(f"{overrides[0]}: overrides are for estimators that are run now")
    if source == "truth":
        truth = required(recording.truth, "this recording has no truth; name an estimator with -e")
        return truth.stamps, truth.poses
    found = (
        read_estimate(recording, file)
        if is_file_of_estimate(file)
        else _run(recording, source, overrides, on_step)
    )
    sound = np.isfinite(found.means).all(axis=1)
    return found.stamps[sound], found.means[sound]


def _run(
    recording: Recording, name: str, overrides: Sequence[str], on_step: Callable[[int], None]
) -> Estimate:
    experiment = experiment_over(recording, name, overrides)
    online, revised = run_over(
        recording,
        experiment.estimator(),
        experiment.prior(recording),
        stream(experiment.seed, f"estimator/{experiment.estimator_name}", 0),
        on_step=on_step,
    )
    return online if revised is None else revised


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
    scan_stamps, ranges_m, sensor = laser_scans(recording, laser)
    require(len(stamps) >= 2, "a map needs a path of two poses or more")
    at_scans = interpolate(stamps, poses, scan_stamps, _LONGEST_GAP_S)
    placed = np.isfinite(at_scans).all(axis=1)
    require(placed.any(), "no scan lies within the time span of the path")
    grid = map_scans(
        at_scans[placed],
        ranges_m[placed],
        sensor,
        resolution_m=resolution_m,
        max_range_m=max_range_m,
        on_progress=on_progress,
    )
    return grid, int(placed.sum())
