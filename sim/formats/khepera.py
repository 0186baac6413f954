"""Khepera calibration tuples: mean wheel speeds and the laser's displacement, interval by interval.

Each tuple is a JSON object `{"T": s, "phi_l": rad/s, "phi_r": rad/s, "sm": [x, y, theta]}`; they
follow one another with white space between, several on a line or one over several lines.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sim import se2
from sim.arrays import Array
from sim.errors import InputError, require
from sim.formats.assemble import chain_motions
from sim.formats.text import json_number, read_bytes, read_members, reason_of
from sim.recording import Recording, Truth, WheelLog
from sim.robot.drive import RobotGeometry
from sim.sensors import Encoder

# What a rolled radian is taken to be until it is calibrated (the robot's data sheet)
NOMINAL_DIAMETER_M, NOMINAL_AXLE_M = 0.041, 0.0885


@dataclass(frozen=True)
class WheelLaserLog:
    """Intervals whose motion both the wheels and the laser measured.

    Attributes
    ----------
    durations_s
        (N,).
    rolled_rad
        (N, 2) angle the right and left wheel turned by.
    laser_motion
        (N, 3) displacement of the laser in its own frame, m, m, rad, by scan matching.
    """

    durations_s: Array
    rolled_rad: Array
    laser_motion: Array


def read_khepera(path: Path, member: str | None = None) -> WheelLaserLog:
    """Read tuples from a file, or from one member of a tar archive.

    Raises
    ------
    InputError
        Naming the file and the line that is not such a tuple.
    """
    if member is None:
        return parse_khepera(read_bytes(path), str(path))
    members = read_members(path)
    require(
        member in members, f"{path}: holds no {member}; it has {', '.join(sorted(members)[:20])}"
    )
    return parse_khepera(members[member], f"{path}/{member}")


def parse_khepera(data: bytes, where: str) -> WheelLaserLog:
    """Tuples from the text of a file."""
    try:
        text = data.decode("ascii")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise InputError(f"{where}:{line}: not ASCII text, so not a log of tuples") from None
    decoder = json.JSONDecoder()
    rows: list[tuple[float, ...]] = []
    at = len(text) - len(text.lstrip())
    while at < len(text):
        try:
            entry, end = decoder.raw_decode(text, at)
            rows.append(_row(entry))
        except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
            line = text.count("\n", 0, at) + 1
            raise InputError(
                f"{where}:{line}: not a tuple of T, phi_l, phi_r, sm ({reason_of(error)})"
            ) from None
        while text[end : end + 1].isspace():
            end += 1
        at = end
    values = np.array(rows, float).reshape(-1, 6)
    return WheelLaserLog(values[:, 0], values[:, 1:3] * values[:, :1], values[:, 3:])


def _row(entry: Any) -> tuple[float, ...]:
    x, y, turn = entry["sm"]
    row = (entry["T"], entry["phi_r"], entry["phi_l"], x, y, turn)
    numbers = tuple(map(json_number, row))
    if numbers[0] <= 0.0:
        raise ValueError("T must be positive")
    return numbers


def to_recording(
    log: WheelLaserLog,
    wheel_diameters_m: tuple[float, float] = (NOMINAL_DIAMETER_M, NOMINAL_DIAMETER_M),
    axle_m: float = NOMINAL_AXLE_M,
    T_base_laser: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Recording:
    """A Recording of the wheels, with the chained scan matches as its reference.

    The stamps are sums of the intervals. A failed scan match stays in the chain.

    Parameters
    ----------
    wheel_diameters_m
        Of the right and left wheel.
    T_base_laser
        Pose of the laser on the robot, m, m, rad.
    """
    stamps = np.concatenate([[0.0], np.cumsum(log.durations_s)])
    steps = log.rolled_rad * np.array(wheel_diameters_m) / 2.0
    travel = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    laser = np.broadcast_to(np.array(T_base_laser), log.laser_motion.shape)
    poses = chain_motions(se2.compose(laser, se2.compose(log.laser_motion, se2.inverse(laser))))
    return Recording(
        frame_stamps=stamps,
        wheels=WheelLog(stamps.copy(), travel),
        robot=RobotGeometry(float(np.mean(wheel_diameters_m)) / 2.0, axle_m),
        sensors={"encoder": Encoder()},
        truth=Truth(stamps.copy(), poses),
        config={"source": "khepera", "truth_of": "laser"},
    )
