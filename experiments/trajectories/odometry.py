"""Estimates in the form of nav_msgs/Odometry, as CSV and JSON (puzzlebot2024, eqs. (10)-(11))."""

import csv
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from estimators.base import Estimate
from sim import se2
from sim.arrays import Array
from sim.errors import InputError, require
from sim.files import require_file, write_text, write_whole
from sim.recording import Recording
from sim.robot.slip import twist_covariances as wheel_covariances

# Entries of x, y, heading in row-major 6x6 covariances in order x, y, z, rotX, rotY, rotZ.
PLANAR = (slice(None), [[0], [1], [5]], [0, 1, 5])


_READ = [
    "header.stamp",
    *(f"pose.position.{axis}" for axis in "xy"),
    *(f"pose.orientation.{axis}" for axis in "zw"),
    *(f"pose.covariance.{i}" for i in range(36)),
]


def covariance_6x6(covariances: Array) -> Array:
    """Covariances (T, 6, 6) with the planar ones (T, 3, 3) in their places, zero elsewhere."""
    full = np.zeros((len(covariances), 6, 6))
    full[PLANAR] = covariances
    return full


def wheel_twist_covariances(
    recording: Recording, stamps: Array, slip: tuple[float, float]
) -> Array:
    """Covariances (T, 3, 3) of the mean velocities between stamps (T,), by the wheels' slip.

    The first stamp has no velocity, and zeros.

    Parameters
    ----------
    slip
        Believed kr and kl, m.
    """
    position_m = recording.wheels.at(stamps)
    travel_m = np.diff(position_m, axis=0, prepend=position_m[:1])
    lapse = np.diff(stamps, prepend=stamps[:1])
    return wheel_covariances(lapse, travel_m, recording.robot.track_m, *slip)


def odometry_records(
    estimate: Estimate, twist_covariances: Array | None = None
) -> list[dict[str, Any]]:
    """One record like nav_msgs/Odometry per stamp.

    The twist is the mean velocity in base_link since the previous record, from differences of the
    poses.

    Parameters
    ----------
    twist_covariances
        (T, 3, 3) of vx, vy, omega, such as `wheel_twist_covariances`; None: unknown, which the
        message's convention writes as zeros.
    """
    stamps, poses = estimate.stamps, estimate.means
    motion = se2.log(se2.between(poses[:-1], poses[1:]))
    lapse = np.maximum(np.diff(stamps), 1e-9)[:, None]
    twists = np.concatenate([np.zeros((len(stamps[:1]), 3)), motion / lapse])
    if twist_covariances is None:
        twist_covariances = np.zeros((len(stamps), 3, 3))
    twist_6x6, records = covariance_6x6(twist_covariances), []
    for i, covariance in enumerate(covariance_6x6(estimate.covariances)):
        x, y, heading = map(float, poses[i])
        vx, vy, turn = map(float, twists[i])
        records.append(
            {
                "header": {"stamp": float(stamps[i]), "frame_id": "odom"},
                "child_frame_id": "base_link",
                "pose": {
                    "position": {"x": x, "y": y, "z": 0.0},
                    "orientation": {
                        "x": 0.0,
                        "y": 0.0,
                        "z": math.sin(heading / 2.0),
                        "w": math.cos(heading / 2.0),
                    },
                    "covariance": covariance.ravel().tolist(),
                },
                "twist": {
                    "linear": {"x": vx, "y": vy, "z": 0.0},
                    "angular": {"x": 0.0, "y": 0.0, "z": turn},
                    "covariance": twist_6x6[i].ravel().tolist(),
                },
            }
        )
    return records


def write_odometry_json(
    estimate: Estimate, path: Path, twist_covariances: Array | None = None
) -> None:
    """Write the records as a JSON list.

    Raises
    ------
    InputError
        If the estimate is not finite, which JSON cannot express.
    """
    try:
        text = json.dumps(odometry_records(estimate, twist_covariances), allow_nan=False)
    except ValueError:
        raise InputError(f"{path}: the estimate is not finite; write it as CSV") from None
    write_text(path, text)


def write_odometry_csv(
    estimate: Estimate, path: Path, twist_covariances: Array | None = None
) -> None:
    """Write one line per record; covariances are pose.covariance.0 to .35, and of the twist."""
    records = [_flat(record) for record in odometry_records(estimate, twist_covariances)]
    require(records, f"{path}: the estimate holds no belief; nothing to write")
    with write_whole(path) as part, part.open("w", newline="") as file:
        writer = csv.DictWriter(file, records[0])
        writer.writeheader()
        writer.writerows(records)


def read_odometry_csv(path: Path) -> Estimate:
    """Read what `write_odometry_csv` wrote.

    Raises
    ------
    InputError
        Naming the file and the line that cannot be read.
    """
    rows = []
    require_file(path)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            table = csv.DictReader(file)
            missing = [name for name in _READ if name not in (table.fieldnames or [])]
            require(
                not missing,
                f"{path}:1: no column {', '.join(missing[:5])}; a CSV has header.stamp, "
                "pose.position.x and .y, pose.orientation.z and .w, and pose.covariance.0 to .35; "
                "write poses alone as TUM",
            )
            for number, row in enumerate(table, start=2):
                cut = next((name for name in _READ if row[name] is None), None)
                require(cut is None, f"{path}:{number}: the line ends before {cut}; is it cut off?")
                try:
                    rows.append([float(row[name]) for name in _READ])
                except (KeyError, TypeError, ValueError) as error:
                    raise InputError(f"{path}:{number}: not an odometry record ({error})") from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: cannot read ({error})") from error
    require(rows, f"{path}: holds no record; write it with `estima run`")
    stamps, x, y, z, w, *covariances = np.array(rows).T
    zero = np.hypot(z, w) < 0.5  # no rotation; that of an estimate that diverged is NaN
    require(not zero.any(), f"{path}:{2 + int(np.argmax(zero))}: the quaternion's length must be 1")
    heading = se2.wrap(2.0 * np.arctan2(z, w))
    full = np.stack(covariances, axis=1).reshape(-1, 6, 6)
    return Estimate(stamps, np.column_stack([x, y, heading]), full[PLANAR])


def _flat(tree: Any, prefix: str = "") -> dict[str, Any]:
    """Dotted names of a record's leaves, and their values."""
    if not isinstance(tree, (dict, list)):
        return {prefix[:-1]: tree}
    parts = tree.items() if isinstance(tree, dict) else enumerate(tree)
    leaves = (_flat(part, f"{prefix}{key}.") for key, part in parts)
    return {name: value for part in leaves for name, value in part.items()}
