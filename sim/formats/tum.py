"""TUM trajectories: lines of `timestamp tx ty tz qx qy qz qw`."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim.errors import InputError
from sim.files import write_whole
from sim.formats.text import read_bytes

Array = NDArray[np.float64]


def write_tum(path: Path, stamps: Array, poses: Array) -> None:
    """Write stamps (T,) s and planar poses (T, 3); 17 digits, so nothing is lost."""
    lines = []
    for stamp, (x, y, heading) in zip(stamps, poses, strict=True):
        qz, qw = math.sin(heading / 2.0), math.cos(heading / 2.0)
        lines.append(f"{stamp:.17g} {x:.17g} {y:.17g} 0 0 0 {qz:.17g} {qw:.17g}\n")
    with write_whole(path) as part:
        part.write_text("".join(lines))


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
    stamps, poses = [], []
    try:
        text = data.decode("ascii")
    except UnicodeDecodeError as error:
        number = data.count(b"\n", 0, error.start) + 1
        raise InputError(
            f"{where}:{number}: cannot read this trajectory ({error.reason})"
        ) from None
    for number, line in enumerate(text.split("\n"), start=1):
        words = line.split("#", maxsplit=1)[0].split()
        if not words:
            continue
        try:
            stamp, x, y, _, qx, qy, qz, qw = (float(word) for word in words)
        except ValueError:
            raise InputError(
                f"{where}:{number}: a line must be timestamp tx ty tz qx qy qz qw"
            ) from None
        norm = qx * qx + qy * qy + qz * qz + qw * qw
        if not math.isfinite(stamp + x + y) or not 0.5 < norm < 1.5:
            raise InputError(
                f"{where}:{number}: numbers must be finite, the quaternion of length 1"
            )
        yaw = math.atan2(2.0 * (qw * qz + qx * qy), norm - 2.0 * (qy * qy + qz * qz))
        stamps.append(stamp)
        poses.append((x, y, yaw))
    return np.array(stamps), np.array(poses, float).reshape(-1, 3)
