"""CARMEN logs: ODOM, FLASER and ROBOTLASER1 lines; and graphs in them, VERTEX2 and EDGE2.

    ODOM x y theta tv rv accel ipc_stamp host logger_stamp
    FLASER n r1..rn laser_x laser_y laser_theta x y theta ipc_stamp host logger_stamp
    ROBOTLASER1 type start_angle fov resolution max_range accuracy remission_mode n r1..rn
      m i1..im laser_x laser_y laser_theta x y theta tv rv forward_safety side_safety
      turn_axis ipc_stamp host logger_stamp

Other lines are skipped. Ranges at or beyond the maximum, and those that are not positive, are
"nothing seen". A FLASER has no angles of its own: its beams are taken to start at -90 degrees
and to be 180 / n degrees apart (180 / (n - 1) for an odd n), as the program that writes them does.
"""

import math
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np

from sim import se2
from sim.arrays import Array
from sim.errors import naming, require
from sim.files import write_text
from sim.formats import assemble
from sim.formats.text import Rows, Words, read_words
from sim.recording import Recording, Truth
from sim.robot.drive import RobotGeometry
from sim.sensors import Laser, Mount

Poses = Literal["odometry", "reference"]

_ODOM, _FLASER, _ROBOTLASER = "ODOM", "FLASER", "ROBOTLASER1"
_FLASER_MAX_RANGE_M = 80.0
_MOST_BEAMS = 100_000
NOMINAL_TRACK_M, NOMINAL_RADIUS_M = 0.33, 0.0975  # of a Pioneer 2, as in most of these logs


@dataclass(frozen=True)
class CarmenLog:
    """What a CARMEN log holds, in the order of its stamps.

    Attributes
    ----------
    odometry_stamps, odometry_poses
        (N,) s and (N, 3) of the ODOM lines.
    scan_stamps, scan_poses
        (M,) s and (M, 3) poses of the robot (not of the laser) with the scans.
    ranges_m
        (M, n) m, as logged.
    laser
        The scanner; its mounting is that of the poses of laser and robot in the log.
    edges
        (M - 1, 3) motion from each scan's vertex to the next by the log's EDGE2 lines, NaN where
        none is known; (0, 3) if the log is not a graph.
    is_graph
        Whether poses are vertices of an optimised graph, not odometry.
    notes
        Counts of what was reordered or dropped.
    where
        The file, for messages.
    """

    odometry_stamps: Array
    odometry_poses: Array
    scan_stamps: Array
    scan_poses: Array
    ranges_m: Array
    laser: Laser
    edges: Array = field(default_factory=lambda: np.zeros((0, 3)))
    is_graph: bool = False
    notes: assemble.Notes = field(default_factory=dict)
    where: str = "CARMEN log"


def read_carmen(source: Path | Words) -> CarmenLog:
    """Read a log, plain or packed.

    Raises
    ------
    InputError
        Naming the file and the line that is not as it should be, or that scans are missing.
    """
    words = read_words(source)
    notes: assemble.Notes = {}
    odometry = words.finite(words.lines_of(_ODOM), 1, 7, "ODOM")
    assemble.require_clock(odometry[:, 6], words.where, "ODOM lines")
    odometry = odometry[assemble.in_order(odometry[:, 6], "odometry", notes)]
    flaser, robotlaser = words.lines_of(_FLASER), words.lines_of(_ROBOTLASER)
    lines, count_column = (robotlaser, 8) if len(robotlaser) >= len(flaser) else (flaser, 1)
    assemble.require_readings(len(lines), 1, words.where, "FLASER or ROBOTLASER1 lines")
    counts = words.whole(lines, count_column, "the number of beams", 1, _MOST_BEAMS)
    n_beams = int(np.bincount(counts).argmax())
    words.refuse(
        words.counts[lines] < count_column + 1 + counts,
        lines,
        "too few words for the ranges it promises",
    )
    if np.any(counts != n_beams):
        notes["scans_of_other_size"] = int(np.sum(counts != n_beams))
        lines = lines[counts == n_beams]
    ranges = words.numbers(lines, count_column + 1, n_beams, "ranges")
    after = count_column + 1 + n_beams
    if count_column == 8:
        remissions = words.whole(lines, after, "the number of remissions", 0, _MOST_BEAMS)
        tail = words.finite(lines, after + 1 + remissions, 12, "poses and stamp of ROBOTLASER1")
        geometry = words.finite(lines, 2, 4, "geometry of ROBOTLASER1")
        kinds, kind = np.unique(geometry, axis=0, return_inverse=True)
        usual = int(np.bincount(kind.ravel()).argmax())
        start, _, step, max_range = kinds[usual]
        if len(kinds) > 1:
            alike = kind.ravel() == usual
            notes["scans_of_other_geometry"] = int(np.sum(~alike))
            lines, ranges, tail = lines[alike], ranges[alike], tail[alike]
        if not (0.0 < step * n_beams < 2.1 * math.pi and 0.0 < max_range <= 1e4):
            raise words.error(int(lines[0]), "impossible resolution or maximum range")
    else:
        tail = words.finite(lines, after, 7, "poses and stamp of FLASER")
        start, step, max_range = -math.pi / 2.0, half_turn_step_rad(n_beams), _FLASER_MAX_RANGE_M
    stamps, laser_poses, poses = tail[:, -1], tail[:, :3], tail[:, 3:6]
    assemble.require_clock(stamps, words.where, "scans")
    rows = assemble.in_order(stamps, "scans", notes)
    x, y, yaw = _mount(poses, laser_poses)
    middle = float(start) + max(float(step) * (n_beams - 1), 1e-9) / 2.0
    with naming(words.where):
        mount = Mount(x_m=x, y_m=y, yaw_rad=float(se2.wrap(yaw + middle)))
    return CarmenLog(
        odometry_stamps=odometry[:, 6].copy(),
        odometry_poses=odometry[:, :3].copy(),
        scan_stamps=stamps[rows],
        scan_poses=poses[rows],
        ranges_m=ranges[rows],
        laser=assemble.scanner(
            assemble.rate_hz(stamps[rows]),
            n_beams,
            float(step),
            float(max_range),
            mount,
        ),
        edges=_edges(words, lines[rows]),
        is_graph=bool(len(words.lines_of("VERTEX2"))),
        notes=notes,
        where=words.where,
    )


def to_recording(
    log: CarmenLog,
    poses: Poses | None = None,
    track_m: float = NOMINAL_TRACK_M,
    wheel_radius_m: float = NOMINAL_RADIUS_M,
) -> Recording:
    """A Recording of the log.

    Parameters
    ----------
    poses
        What the log's poses are: `odometry`, from which the wheels are rebuilt, or a
        `reference`, which becomes the truth; the wheels then come from the graph's edges, or
        stand still if there are none. None: a reference if the log is a graph.
    track_m, wheel_radius_m
        The robot's; the arcs are the same for any.

    Raises
    ------
    InputError
        If there are fewer than two readings.
    """
    notes = dict(log.notes)
    if (poses or ("reference" if log.is_graph else "odometry")) == "odometry":
        stamps = np.concatenate([log.odometry_stamps, log.scan_stamps])
        all_poses = np.concatenate([log.odometry_poses, log.scan_poses])
        rows = assemble.in_order(stamps, "poses", {})
        assemble.require_readings(len(rows), 2, log.where, "poses at different stamps")
        wheels = assemble.wheels_from_poses(stamps[rows], all_poses[rows], track_m, notes)
        truth = None
    else:
        assemble.require_readings(len(log.scan_stamps), 2, log.where, "scans")
        edges = log.edges if len(log.edges) else np.zeros((len(log.scan_stamps) - 1, 3))
        if missing := int(np.sum(~np.isfinite(edges).all(axis=1))):
            notes["edges_missing"] = missing
        chain = assemble.chain_motions(np.nan_to_num(edges))
        wheels = assemble.wheels_from_poses(log.scan_stamps.copy(), chain, track_m, notes)
        notes["wheels_from"] = "edges of the graph" if len(log.edges) else "nothing"
        truth = Truth(log.scan_stamps.copy(), log.scan_poses.copy())
    return assemble.scan_recording(
        wheels,
        log.scan_stamps,
        log.ranges_m,
        log.laser,
        truth,
        RobotGeometry(wheel_radius_m, track_m),
        {"source": "carmen", "notes": notes},
    )


def half_turn_step_rad(n_beams: int) -> float:
    """Angle between the beams of a half turn: 180 / n degrees, or 180 / (n - 1) for an odd n.

    A scanner with a beam at either end of the half turn has an odd number of them, such as 181.
    """
    return math.pi / (n_beams - n_beams % 2) if n_beams > 1 else math.pi


def _mount(poses: Array, laser_poses: Array) -> list[float]:
    """Pose of the laser on the robot: the median over the log."""
    mounts = se2.between(poses, laser_poses)
    first = mounts[0, 2]
    yaw = se2.wrap(first + np.median(se2.wrap(mounts[:, 2] - first)))
    return [*np.median(mounts[:, :2], axis=0).tolist(), float(yaw)]


def _edges(words: Words, scan_lines: Rows) -> Array:
    """Motion between consecutive scans by EDGE2 lines; each scan follows its VERTEX2 line.

    Only edges from a vertex to the next one count, not those that close loops. Stamps may order
    scans otherwise than their vertices; such a motion is composed of the edges between.
    """
    vertices, edges = words.lines_of("VERTEX2"), words.lines_of("EDGE2")
    if not len(vertices) or not len(edges) or len(scan_lines) < 2:
        return np.zeros((0, 3))
    above = np.searchsorted(vertices, scan_lines) - 1
    words.refuse(above < 0, scan_lines, "a scan without its VERTEX2")
    ids = words.finite(vertices, 1, 1, "VERTEX2")[:, 0]
    values = words.finite(edges, 1, 5, "EDGE2")
    motion = {(row[0], row[1]): row[2:] for row in values[::-1]}  # the first of a pair counts
    steps = np.array([motion.get(pair, [np.nan] * 3) for pair in pairwise(ids)]).reshape(-1, 3)
    known = np.isfinite(steps).all(axis=1)
    poses = se2.chain(np.where(known[:, None], steps, 0.0))
    gaps = np.concatenate([[0], np.cumsum(~known)])
    first, second = above[:-1], above[1:]
    found = se2.between(poses[first], poses[second])
    found[gaps[first] != gaps[second]] = np.nan
    next_one = second == first + 1
    found[next_one] = steps[first[next_one]]
    return found


def write_carmen(path: Path, recording: Recording) -> None:
    """Write a Recording's odometry and scans as ODOM and ROBOTLASER1 lines.

    What the format cannot hold (landmarks, clouds, the truth) is dropped. Unseen beams are
    written as the maximum range.

    Raises
    ------
    InputError
        If the recording has no laser, or the file cannot be written.
    """
    require(
        "laser" in recording.logs,
        f"{path}: a CARMEN log needs a laser, and this recording has none",
    )
    laser, log = recording.sensor("laser", Laser), recording.log("laser")
    poses = assemble.pose_by_wheels(recording.wheels, recording.robot.track_m)
    heading = np.unwrap(poses[:, 2])
    lines = [
        f"ODOM {x:.17g} {y:.17g} {a:.17g} 0 0 0 {t:.17g} estima {t:.17g}"
        for t, (x, y, a) in zip(recording.wheels.stamps, poses, strict=True)
    ]
    start, n_beams = float(laser.bearings_rad[0]), laser.n_beams
    step_rad = float(np.diff(laser.bearings_rad[:2])[0]) if n_beams > 1 else laser.fov_rad
    head = f"ROBOTLASER1 0 {start:.17g} {laser.fov_rad:.17g} {step_rad:.17g} "
    head += f"{laser.max_range_m:.17g} {laser.sigma_range_m:.17g} 0 {n_beams}"
    for t, scan in zip(log.stamps, log["ranges_m"], strict=True):
        at = [np.interp(t, recording.wheels.stamps, c) for c in (*poses[:, :2].T, heading)]
        written = np.where(np.isfinite(scan), scan.astype(np.float64), laser.max_range_m)
        numbers = " ".join(f"{r:.9g}" for r in written)
        both = " ".join(f"{v:.17g}" for v in (*se2.compose(np.array(at), laser.mount.pose), *at))
        lines.append(f"{head} {numbers} 0 {both} 0 0 0 0 0 {t:.17g} estima {t:.17g}")
    write_text(path, "\n".join(lines) + "\n")
