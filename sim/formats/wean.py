"""Wean Hall logs and map: odometry, 180-beam scans, and a grid of probabilities.

    O x y theta stamp
    L x y theta x_laser y_laser theta_laser r1 .. r180 stamp        cm, rad, s

The map has seven lines of header and 800 x 800 cells of 10 cm: -1 where nothing is known, else a
probability. The file does not say whether 1 means free or occupied: see `Grid.free_is_one`.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sim import se2
from sim.arrays import Array
from sim.errors import naming, require
from sim.formats import assemble
from sim.formats.text import Words, read_words
from sim.recording import Recording
from sim.robot.drive import RobotGeometry
from sim.sensors import Mount
from sim.worlds.grid import OccupancyGrid

_N_BEAMS = 180
_NO_RETURN_M = 81.83  # and beyond, up to 81.91
_MOST_CELLS = 20_000
NOMINAL_TRACK_M, NOMINAL_RADIUS_M = 0.40, 0.1


@dataclass(frozen=True)
class Grid:
    """Cells (X, Y) of a map, first index along x: NaN where nothing is known, else a number.

    Attributes
    ----------
    values
        (X, Y) in [0, 1] or NaN.
    cell_m
        Side of a cell; the corner of cell (0, 0) is the origin of the map's frame.
    free_is_one
        Whether 1 stands for free. The text that came with the map says that 1 is occupied; the
        scans say that it is free (beams end where values are low), and there is far more free
        space than walls.
    """

    values: Array
    cell_m: float
    free_is_one: bool = True

    @property
    def occupancy(self) -> Array:
        """Probability (X, Y) that a cell is occupied, NaN where nothing is known."""
        return 1.0 - self.values if self.free_is_one else self.values

    @property
    def grid(self) -> OccupancyGrid:
        """The map as all methods know one."""
        return OccupancyGrid(self.occupancy.T.astype(np.float32), self.cell_m)


def read_wean(
    source: Path | Words,
    track_m: float = NOMINAL_TRACK_M,
    wheel_radius_m: float = NOMINAL_RADIUS_M,
) -> Recording:
    """A Recording of a log, without truth.

    Raises
    ------
    InputError
        Naming the file and the line.
    """
    words = read_words(source)
    notes: assemble.Notes = {}
    lines, scan_lines = words.lines_of("O"), words.lines_of("L")
    assemble.require_readings(len(scan_lines), 1, words.where, "L lines")
    odometry = words.finite(lines, 1, 4, "an O line")
    head = words.finite(scan_lines, 1, 6, "poses of an L line")
    ranges = words.numbers(scan_lines, 7, _N_BEAMS, "the 180 ranges")
    stamps = words.finite(scan_lines, 7 + _N_BEAMS, 1, "the stamp of an L line")[:, 0]
    all_stamps = np.concatenate([odometry[:, 3], stamps])
    poses = np.concatenate([odometry[:, :3], head[:, :3]])
    poses[:, :2] /= 100.0
    rows = assemble.in_order(all_stamps, "poses", notes)
    assemble.require_readings(len(rows), 2, words.where, "poses at different stamps")
    wheels = assemble.wheels_from_poses(all_stamps[rows], poses[rows], track_m, notes)
    assemble.require_clock(stamps, words.where, "scans")
    order = assemble.in_order(stamps, "scans", notes)
    of_laser = head[:, 3:] / np.array([100.0, 100.0, 1.0])
    x, y, yaw = np.median(se2.between(poses[len(odometry) :], of_laser), axis=0).tolist()
    step = math.pi / _N_BEAMS
    with naming(words.where):
        mount = Mount(x_m=x, y_m=y, yaw_rad=yaw - step / 2.0)
    return assemble.scan_recording(
        wheels,
        stamps[order],
        ranges[order] / 100.0,
        assemble.scanner(5.0, _N_BEAMS, step, _NO_RETURN_M, mount),
        None,
        RobotGeometry(wheel_radius_m, track_m),
        {"source": "wean", "notes": notes},
    )


def read_grid(source: Path | Words) -> Grid:
    """Read a map.

    Raises
    ------
    InputError
        Naming the file and the line.
    """
    words = read_words(source)
    header = {key.partition(b"[")[0]: lines[0] for key, lines in words.lines_by_keyword.items()}
    where, line = f"{words.where}:1", header.get(b"global?map", -1)
    cell_m, n_x, n_y = 0.1, 0, 0
    if b"robot?specifications->resolution" in header:
        at = np.array([header[b"robot?specifications->resolution"]])
        cell_m = float(words.finite(at, 1, 1, "the resolution")[0, 0]) / 100.0
    if line >= 0:
        where = f"{words.where}:{words.line_numbers[line]}"
        n_x, n_y = words.finite(np.array([line]), 1, 2, "the map's size")[0].astype(int).tolist()
    require(
        0 < n_x <= _MOST_CELLS and 0 < n_y <= _MOST_CELLS and 0.0 < cell_m < 100.0,
        f"{where}: no `global_map[0]: width height` of a map in it; `estima map` maps a log",
    )
    begin = words.first[line + 1]
    cells = words.values[begin:]
    require(
        len(cells) == n_x * n_y,
        f"{where}: {n_x} x {n_y} cells are promised, {len(cells)} are there",
    )
    for bad in np.flatnonzero(~(np.abs(cells) <= 1.0))[:1]:
        row = int(np.searchsorted(words.first, begin + bad, side="right")) - 1
        raise words.error(row, "a cell must be -1 or a number from 0 to 1")
    return Grid(np.where(cells < 0.0, np.nan, cells).reshape(n_x, n_y), cell_m)
