"""TUM trajectories: lines of `timestamp tx ty tz qx qy qz qw`."""

import math
from pathlib import Path

import numpy as np

from sim.arrays import Array
from sim.files import write_text
from sim.formats.text import read_bytes, split_words


def write_tum(path: Path, stamps: Array, poses: Array) -> None:
    """Write stamps (T,) s and planar poses (T, 3); 17 digits, so nothing is lost."""
    lines = []
    for stamp, (x, y, heading) in zip(stamps, poses, strict=True):
        qz, qw = math.sin(heading / 2.0), math.cos(heading / 2.0)
        lines.append(f"{stamp:.17g} {x:.17g} {y:.17g} 0 0 0 {qz:.17g} {qw:.17g}\n")
    write_text(path, "".join(lines))


def read_tum(path: Path) -> tuple[Array, Array]:
    """Read stamps (T,) s and poses (T, 3) m, m, rad; height, roll and pitch are dropped.

    Raises
    ------
    InputError
        Naming the file and the line that is not eight finite numbers.
    """
    return parse_tum(read_bytes(path), str(path))


def parse_tum(data: bytes, where: str) -> tuple[Array, Array]:
    """As `read_tum`, of a file's contents."""
    return parse_spatial_tum(data, where)[:2]


def parse_spatial_tum(data: bytes, where: str) -> tuple[Array, Array, Array, Array]:
    """As `parse_tum`, with what it drops: heights (T,) m, tilts (T,) rad of its upright axis."""
    columns = "timestamp tx ty tz qx qy qz qw"
    words = split_words(data, where)
    words.refuse(words.counts != 8, words.lines, f"a line must be {columns}")
    table = words.numbers(words.lines, 0, 8, columns)
    x, y, (qx, qy, qz, qw) = table[:, 1], table[:, 2], table[:, 4:].T
    with np.errstate(over="ignore"):
        norm = np.sum(table[:, 4:] ** 2, axis=1)
    sound = np.isfinite(table[:, :3]).all(axis=1) & (norm > 0.5) & (norm < 1.5)
    words.refuse(~sound, words.lines, "numbers must be finite, the quaternion of length 1")
    yaw = np.arctan2(2.0 * (qw * qz + qx * qy), norm - 2.0 * (qy * qy + qz * qz))
    tilt = 2.0 * np.arctan2(np.hypot(qx, qy), np.hypot(qz, qw))
    return table[:, 0].copy(), np.stack([x, y, yaw], axis=1), table[:, 3], tilt
