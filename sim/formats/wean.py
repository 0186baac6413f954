"""Wean Hall logs and map: odometry, 180-beam scans, and a grid of probabilities.

    O x y theta stamp
    L x y theta x_laser y_laser theta_laser r1 .. r180 stamp        cm, rad, s

The map has seven lines of header and 800 x 800 cells of 10 cm: -1 where nothing is known, else a
probability. What the probability is of, the file does not say: see `Grid.free_is_one`.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sim import se2
from sim.arrays import Array
from sim.errors import InputError, require
from sim.formats import assemble
from sim.formats.carmen import scan_recording, seen_ranges
from sim.formats.text import Words, read_bytes, read_words, split_words
from sim.recording import Recording
from sim.sensors import Laser, Mount

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


def read_wean(
    path: Path,
    track_m: float = NOMINAL_TRACK_M,
    wheel_radius_m: float = NOMINAL_RADIUS_M,
) -> Recording:
    """A Recording of a log; there is no truth.

    Raises
    ------
    InputError
        Naming the file and the line.
    """
    return parse_wean(read_words(path), track_m, wheel_radius_m)


def parse_wean(
    words: Words, track_m: float = NOMINAL_TRACK_M, wheel_radius_m: float = NOMINAL_RADIUS_M
) -> Recording:
    """The log in a file's words."""
    notes: assemble.Notes = {}
    lines, scan_lines = words.lines_of("O"), words.lines_of("L")
    assemble.require_readings(len(scan_lines), 1, words.where, "L lines")
    odometry = words.finite(lines, 1, 4, "an O line")
    head = words.finite(scan_lines, 1, 6, "poses of an L line")
    raw = words.numbers(scan_lines, 7, _N_BEAMS, "the 180 ranges")
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
    mount = np.median(se2.between(poses[len(odometry) :], of_laser), axis=0)
    step = math.pi / _N_BEAMS
    laser = Laser(
        rate_hz=5.0,
        n_beams=_N_BEAMS,
        fov_rad=step * (_N_BEAMS - 1),
        max_range_m=_NO_RETURN_M,
        mount=Mount(x_m=float(mount[0]), y_m=float(mount[1]), yaw_rad=float(mount[2]) - step / 2.0),
    )
    return scan_recording(
        wheels,
        stamps[order],
        seen_ranges(raw[order] / 100.0, _NO_RETURN_M),
        laser,
        None,
        track_m,
        wheel_radius_m,
        {"source": "wean", "notes": notes},
    )


def read_grid(path: Path) -> Grid:
    """Read a map.

    Raises
    ------
    InputError
        Naming the file and the line.
    """
    return parse_grid(read_bytes(path), str(path))


def parse_grid(data: bytes, where: str) -> Grid:
    """The map in a file's text."""
    cell_m, n_x, n_y, at, number = 0.1, 0, 0, 0, 0
    for number in range(1, 50):
        end = data.find(b"\n", at)
        words = data[at : end if end >= 0 else len(data)].decode("ascii", "replace").split()
        at = end + 1
        try:
            if words and words[0].startswith("robot_specifications->resolution"):
                cell_m = float(words[1]) / 100.0
            if words and words[0].startswith("global_map"):
                n_x, n_y = int(words[1][:9]), int(words[2][:9])
                break
        except (ValueError, IndexError):
            raise InputError(f"{where}:{number}: a number is missing in the header") from None
        if end < 0:
            break
    require(
        0 < n_x <= _MOST_CELLS and 0 < n_y <= _MOST_CELLS and 0.0 < cell_m < 100.0,
        f"{where}:{number}: no `global_map[0]: width height` of a map in it",
    )
    cells = split_words(data[at:] if at else b"", where)
    cells.line_numbers[:] += number
    require(
        len(cells.values) == n_x * n_y,
        f"{where}:{number}: {n_x} x {n_y} cells are promised, {len(cells.values)} are there",
    )
    bad = np.flatnonzero(~cells.is_number | ~(np.abs(cells.values) <= 1.0))
    if len(bad):
        line = int(np.searchsorted(cells.first, bad[0], side="right")) - 1
        raise cells.error(line, "a cell must be -1 or a number from 0 to 1")
    return Grid(np.where(cells.values < 0.0, np.nan, cells.values).reshape(n_x, n_y), cell_m)
