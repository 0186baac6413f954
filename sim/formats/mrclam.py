"""MRCLAM: robots with velocities, ranges and bearings to barcoded landmarks, and motion capture.

A data set is a folder or a tar archive of `RobotN_Odometry.dat` (t v omega),
`RobotN_Measurement.dat` (t barcode depth bearing), `RobotN_Groundtruth.dat` (t x y theta),
`Landmark_Groundtruth.dat` (subject x y sigma_x sigma_y) and `Barcodes.dat` (subject barcode).
Subjects that have no place in the landmark file are the other robots. Of one robot alone they are
dropped, as unknown barcodes are; `read_team` keeps them as sightings.

What the files call range is the depth d along the camera's optical axis: on all robots of set 6 its
error relative to the motion capture is the same at every bearing when it is read so, and changes by
a tenth when it is read as a range. With the bearing b it becomes the point (-d tan b, 0, d) of the
camera frame (x right, y down, z forward), with landmarks at the camera's height. The believed
noise is that of a stereo camera whose disparity error gives the growth of the depth error and
whose column error gives that of the bearing.
"""

import dataclasses
import math
import re
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from sim.arrays import Array, Ints, Values
from sim.errors import InputError, require
from sim.formats import assemble
from sim.formats.text import read_members, split_words
from sim.recording import Log, Recording, Truth
from sim.robot.drive import RobotGeometry
from sim.sensors import Encoder, Mount, RobotCamera, StereoCamera
from sim.team import Team
from sim.worlds.world import World

# An iRobot Create
TRACK_M, WHEEL_RADIUS_M = 0.258, 0.033
_MOST_BEARING_RAD = math.radians(80.0)  # beyond, a depth says next to nothing of the distance
# Range error 0.008 z^2 (0.1 m at 3.5 m, 0.4 m at 7 m), bearing error 1.5 degrees
CAMERA = StereoCamera(
    rate_hz=10.0,
    focal_px=100.0,
    baseline_m=1.0,
    fov_horizontal_rad=math.radians(100.0),
    fov_vertical_rad=math.radians(10.0),
    max_distance_m=15.0,
    sigma_column_px=2.6,
    sigma_row_px=0.5,
    sigma_disparity_px=0.8,
    mount=Mount(z_m=0.0),
)


def read_mrclam(
    path: Path,
    robot: int = 1,
    identifies: bool = True,
    camera: StereoCamera = CAMERA,
    *,
    members: Mapping[str, bytes] | None = None,
) -> Recording:
    """A Recording of one robot of a data set.

    Parameters
    ----------
    path
        Folder or tar archive.
    robot
        Its number, as in the files' names.
    identifies
        Whether the observations carry the landmark's number (row of the landmark file).
    camera
        The believed noise of the observations.
    members
        Contents of the files by their names, where they were read before.

    Raises
    ------
    InputError
        Naming the file and the line, or the file that is missing.
    """
    members = read_members(path) if members is None else members
    odometry, measured, truth, landmarks, barcodes = (
        _table(members, path, name, n_columns)
        for name, n_columns in (
            (f"Robot{robot}_Odometry", 3),
            (f"Robot{robot}_Measurement", 4),
            (f"Robot{robot}_Groundtruth", 4),
            ("Landmark_Groundtruth", 5),
            ("Barcodes", 2),
        )
    )
    for name, names in (("Barcodes", barcodes[:, 1]), ("Landmark_Groundtruth", landmarks[:, 0])):
        each, counts = np.unique(names, return_counts=True)
        for twice in each[counts > 1][:1]:
            raise InputError(f"{path}: {name} names {twice:g} twice; keep one line of it")
    notes: assemble.Notes = {}
    odometry = odometry[assemble.in_order(odometry[:, 0], "odometry", notes)]
    truth = truth[assemble.in_order(truth[:, 0], "truth", notes)]
    assemble.require_readings(len(odometry), 2, str(path), "odometry readings")
    assemble.require_readings(len(truth), 2, str(path), "ground truth poses")
    wheels = assemble.wheels_from_velocities(odometry[:, 0].copy(), odometry[:, 1:], TRACK_M)
    ids = _rows_of(measured[:, 1], barcodes, landmarks[:, 0])
    n_unknown = int(np.sum(~np.isin(measured[:, 1], barcodes[:, 1])))
    notes["unknown_barcodes"] = n_unknown
    notes["observations_of_robots"] = int(np.sum(ids < 0)) - n_unknown
    camera = dataclasses.replace(camera, identifies=identifies)
    log, true_ids = _observations(measured, ids, camera, notes)
    world = World(
        "mrclam",
        walls=np.zeros((0, 4)),
        wall_z_m=np.zeros((0, 2)),
        landmarks=np.column_stack([landmarks[:, 1:3], np.full(len(landmarks), camera.mount.z_m)]),
    )
    hidden = {"stereo": {"true_ids": true_ids}}
    return Recording(
        frame_stamps=assemble.frame_stamps(wheels.stamps, [log.stamps]),
        wheels=wheels,
        robot=RobotGeometry(WHEEL_RADIUS_M, TRACK_M),
        sensors={"encoder": Encoder(rate_hz=None), "stereo": camera},
        logs={"stereo": log},
        truth=Truth(truth[:, 0].copy(), truth[:, 1:].copy(), readings=hidden, world=world),
        config={"source": "mrclam", "robot": robot, "notes": notes},
    )


def robots_in(members: Iterable[str]) -> list[int]:
    """Numbers of the robots of a data set, by the names of its files."""
    found = (re.fullmatch(r"Robot(\d+)_Odometry\.dat", name) for name in members)
    return sorted(int(match[1]) for match in found if match)


def _table(members: Mapping[str, bytes], path: Path, name: str, n_columns: int) -> Array:
    """Table of a file of the set."""
    robots = sorted(m[5:-13] for m in members if m.endswith("_Odometry.dat"))
    known = ", ".join(robots[:10]).encode("unicode_escape").decode()
    require(
        f"{name}.dat" in members,
        f"{path}: holds no {name}.dat; robots with odometry: {known}",
    )
    what = name.rpartition("_")[2].lower()
    return split_words(members[f"{name}.dat"], f"{path}/{name}.dat").table(n_columns, what)


def read_team(path: Path, camera: StereoCamera = CAMERA) -> Team:
    """All robots of a data set, in the order of their numbers, on one clock.

    Each has its sightings of the others in a log `robots`, under their numbers in the team. The
    markers are taken to be at the camera's height, and as noisy as landmarks.

    Raises
    ------
    InputError
        As for `read_mrclam`.
    """
    members = read_members(path)
    robots = robots_in(members)
    sensor = RobotCamera(
        **{f.name: getattr(camera, f.name) for f in dataclasses.fields(RobotCamera)[:-2]},
        marker_z_m=camera.mount.z_m,
        mount=camera.mount,
    )
    team = []
    for robot in robots:
        recording = read_mrclam(path, robot, camera.identifies, camera, members=members)
        measured = _table(members, path, f"Robot{robot}_Measurement", 4)
        codes, notes = _table(members, path, "Barcodes", 2), dict(recording.config["notes"])
        # subject N is robot N
        ids = _rows_of(measured[:, 1], codes, np.array(robots, float))
        log, true_ids = _observations(measured, ids, sensor, notes)
        notes["sightings_of_robots"] = len(true_ids)
        hidden = {**recording.known_truth.readings, "robots": {"true_ids": true_ids}}
        team.append(
            dataclasses.replace(
                recording.with_log("robots", log, sensor),
                truth=dataclasses.replace(recording.known_truth, readings=hidden),
                config={**recording.config, "notes": notes},
            )
        )
    return Team.on_one_clock(team)


def _rows_of(codes: Array, barcodes: Array, subjects: Array) -> Ints:
    """Row of the subject of each barcode; -1 for other ones and unknown codes."""
    subject_of = {float(code): float(subject) for subject, code in barcodes}
    row_of = {float(subject): row for row, subject in enumerate(subjects)}
    return np.array([row_of.get(subject_of.get(float(c), math.nan), -1) for c in codes], np.int64)


def _observations(
    measured: Array,
    ids: Ints,
    camera: StereoCamera | RobotCamera,
    notes: assemble.Notes,
) -> tuple[Log, Ints]:
    """Observations by image, in order, and the true ids of their rows."""
    ahead = np.abs(measured[:, 3]) < _MOST_BEARING_RAD
    usable = (ids >= 0) & ahead & (measured[:, 2] > 0.0)
    notes["observations_behind"] = int(np.sum((ids >= 0) & ~usable))
    order = np.flatnonzero(usable)[np.argsort(measured[usable, 0], kind="stable")]
    measured, ids = measured[order], ids[order]
    stamps, first = np.unique(measured[:, 0], return_index=True)
    depth_m, bearing = measured[:, 2], measured[:, 3]
    points = np.stack([-depth_m * np.tan(bearing), np.zeros_like(depth_m), depth_m], axis=1)
    splits = np.append(first, len(measured)).astype(np.int64)
    shown: dict[str, Values] = {"ids": ids} if camera.identifies else {}
    if "descriptors" in camera.schema:
        shown["descriptors"] = np.zeros((len(ids), 0), np.float32)
    return Log.of(camera, stamps, splits, points_in_camera=points, **shown), ids
