"""Rawseeds CSV: odometry, SICK scans, ground truth, and trajectories in the toolkit's layout.

ODOMETRY_XYT   stamp, rolling counter, ticks right, ticks left, x, y, theta
SICK_*         stamp, number of ranges, angular offset (1/4 degree), r1 .. rN
GROUNDTRUTH    stamp, x, y, theta, and the 3 x 3 covariance row by row
trajectories   stamp, x, y, theta
"""

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sim.arrays import Array
from sim.errors import require
from sim.formats import assemble
from sim.formats.text import Words, read_words
from sim.recording import Recording, Truth, WheelLog
from sim.robot.drive import RobotGeometry
from sim.sensors import Mount

TRACK_M, WHEEL_RADIUS_M = 0.48, 0.095  # of the Robocom the sets were recorded with, nominal
FRONT_SICK = Mount(x_m=0.08, y_m=0.0, z_m=0.45)
REAR_SICK = Mount(x_m=-0.463, y_m=0.001, z_m=0.454, yaw_rad=math.pi)
_MAX_RANGE_M = 80.0
_MOST_BEAMS = 3601


@dataclass(frozen=True)
class Trajectory:
    """Stamps (T,) s, strictly increasing; poses (T, 3); covariances (T, 3, 3), or (0, 3, 3)."""

    stamps: Array
    poses: Array
    covariances: Array


def read_trajectory(source: Path | Words) -> Trajectory:
    """Ground truth (13 columns) or a trajectory (4 columns).

    It is sorted by stamp; of equal stamps the last one counts.

    Raises
    ------
    InputError
        Naming the file and the line.
    """
    table = read_words(source).table((4, 13), "a Rawseeds trajectory")
    table = table[assemble.in_order(table[:, 0], "poses", {})]
    covariances = table[:, 4:].reshape(-1, 3, 3) if table.shape[1] == 13 else np.zeros((0, 3, 3))
    return Trajectory(table[:, 0].copy(), table[:, 1:4].copy(), covariances)


def parse_sick(words: Words, resolution_deg: float = 1.0) -> tuple[Array, Array, float, float]:
    """Stamps (N,), ranges (N, n) m, start angle and step (rad) of a SICK file.

    The offset counts quarter degrees from -90 on; a step is the resolution.
    """
    step = math.radians(resolution_deg)
    lines = words.lines
    head = words.finite(lines, 0, 3, "stamp, count and offset")
    counts = words.whole(lines, 1, "the number of ranges", 1, _MOST_BEAMS)
    assemble.require_readings(len(lines), 1, words.where, "scans")
    different = (counts != counts[0]) | (head[:, 2] != head[0, 2])
    words.refuse(different, lines, "a scan of another size or offset than the first")
    if not 0.0 <= head[0, 2] < 4.0:
        raise words.error(0, "the angular offset must be 0 to 3 quarter degrees")
    if not 0.0 < step * counts[0] <= 2.0 * math.pi + 1e-9:
        raise words.error(
            0, f"{counts[0]} ranges every {resolution_deg:g} degrees; state another resolution_deg"
        )
    ranges = words.numbers(lines, 3, int(counts[0]), "ranges")
    start = -math.pi / 2.0 + math.radians(head[0, 2] / 4.0)
    return head[:, 0].copy(), ranges, start, step


def read_rawseeds(
    odometry: Path,
    scans: Path,
    truth: Path | None = None,
    *,
    mount: Mount = FRONT_SICK,
    track_m: float = TRACK_M,
    wheel_radius_m: float = WHEEL_RADIUS_M,
    resolution_deg: float = 1.0,
    m_per_tick: float | None = None,
) -> Recording:
    """A Recording of odometry, one SICK scanner and, if there is one, a ground truth.

    Parameters
    ----------
    mount
        Where the scanner sits: `FRONT_SICK` or `REAR_SICK`.
    resolution_deg
        Angle between beams.
    m_per_tick
        Travel of a wheel per tick, where a line has the ticks since the one before; None to take
        the wheels from the logged poses.
    """
    notes: assemble.Notes = {}
    table = read_words(odometry).table(7, "Rawseeds odometry")
    assemble.require_clock(table[:, 0], str(odometry), "odometry readings")
    rows = assemble.in_order(table[:, 0], "odometry", notes)
    assemble.require_readings(len(rows), 2, str(odometry), "odometry readings")
    stamps = table[rows, 0]
    if m_per_tick is None:
        wheels = assemble.wheels_from_poses(stamps, table[rows, 4:], track_m, notes)
    else:
        require(
            math.isfinite(m_per_tick) and m_per_tick != 0.0,
            f"m_per_tick must be a number other than zero, got {m_per_tick}",
        )
        wheels = WheelLog(stamps, m_per_tick * np.cumsum(table[:, 2:4], axis=0)[rows])
    times, ranges, start, step = parse_sick(read_words(scans), resolution_deg)
    assemble.require_clock(times, str(scans), "scans")
    rows = assemble.in_order(times, "scans", notes)
    n_beams = ranges.shape[1]
    yaw = mount.yaw_rad + start + max(step * (n_beams - 1), 1e-9) / 2.0
    reference = None
    if truth is not None:
        trajectory = read_trajectory(truth)
        reference = Truth(trajectory.stamps, trajectory.poses)
    return assemble.scan_recording(
        wheels,
        times[rows],
        ranges[rows],
        assemble.scanner(
            75.0, n_beams, step, _MAX_RANGE_M, dataclasses.replace(mount, yaw_rad=yaw)
        ),
        reference,
        RobotGeometry(wheel_radius_m, track_m),
        {"source": "rawseeds", "notes": notes},
    )
