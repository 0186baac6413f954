"""TUM trajectories: lines of `timestamp tx ty tz qx qy qz qw`.

Behind these may stand a planar covariance, `xx xy xh yy yh hh` (m and rad; h is the heading):
no part of the format, but the plainest way for a program to say what it believes.
"""

from pathlib import Path

import numpy as np

from sim.arrays import Array
from sim.files import write_whole
from sim.formats.text import Words, read_words

_COVARIANCE = "xx xy xh yy yh hh"
_UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def write_tum(path: Path, stamps: Array, poses: Array) -> None:
    """Write stamps (T,) s and planar poses (T, 3); 17 digits, so nothing is lost."""
    half, flat = poses[:, 2] / 2.0, np.zeros((len(poses), 3))
    table = np.column_stack([stamps, poses[:, :2], flat, np.sin(half), np.cos(half)])
    with write_whole(path) as part:
        np.savetxt(part, table, "%.17g")


def read_tum(source: Path | Words) -> tuple[Array, Array]:
    """Read stamps (T,) s and poses (T, 3) m, m, rad; height, roll and pitch are dropped.

    Raises
    ------
    InputError
        Naming the file and the line that is not eight finite numbers, or fourteen.
    """
    return read_spatial_tum(source)[:2]


def read_spatial_tum(source: Path | Words) -> tuple[Array, Array, Array, Array, Array]:
    """As `read_tum`, with what it drops.

    Returns
    -------
    tuple
        Stamps and poses, heights (T,) m, tilts (T,) rad of its upright axis, and covariances
        (T, 3, 3), zeros where a line has none.
    """
    columns, words = "timestamp tx ty tz qx qy qz qw", read_words(source)
    knows = words.counts == 8 + len(_UPPER)
    complaint = f"a line must be {columns}, with or without a covariance {_COVARIANCE} behind it"
    words.refuse(~knows & (words.counts != 8), words.lines, complaint)
    table = words.numbers(words.lines, 0, 8, columns)
    covariances = np.zeros((len(table), 3, 3))
    upper = words.numbers(words.lines[knows], 8, len(_UPPER), _COVARIANCE)
    for (i, j), values in zip(_UPPER, upper.T, strict=True):
        covariances[knows, i, j] = covariances[knows, j, i] = values
    stamps, x, y, height, qx, qy, qz, qw = table.T
    with np.errstate(over="ignore"):
        norm = np.sum(table[:, 4:] ** 2, axis=1)
    sound = np.isfinite(table[:, :3]).all(axis=1) & (norm > 0.5) & (norm < 1.5)
    words.refuse(~sound, words.lines, "numbers must be finite, the quaternion of length 1")
    yaw = np.arctan2(2.0 * (qw * qz + qx * qy), norm - 2.0 * (qy * qy + qz * qz))
    tilt = 2.0 * np.arctan2(np.hypot(qx, qy), np.hypot(qz, qw))
    return stamps.copy(), np.stack([x, y, yaw], axis=1), height, tilt, covariances
