"""A sheet of end poses, as puzzlebot2024 keeps one: a line each run, with its command and end.

Columns: `case` (any name), `v_mps`, `omega_radps` and `duration_s` of the command, and `x_m`,
`y_m`, `heading_rad` of the final pose in the frame of the start pose.
"""

import csv
import io
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from experiments.calibration.end_poses import Manoeuvre, from_end_poses
from experiments.calibration.result import CalibrationResult
from sim.arrays import Array
from sim.errors import InputError, require
from sim.files import read_text
from sim.formats.text import LARGEST
from sim.robot.drive import DifferentialDrive
from sim.routes.route import OpenLoop

COMMAND = ("v_mps", "omega_radps", "duration_s")
END_POSE = ("x_m", "y_m", "heading_rad")
COLUMNS = ("case", *COMMAND, *END_POSE)
_MOST = {"v_mps": 100.0, "omega_radps": 100.0, "duration_s": 3600.0}


def calibrate_sheet(
    path: Path, robot: DifferentialDrive, rng: np.random.Generator, *, geometry: bool = False
) -> CalibrationResult:
    """Calibrate from a sheet by the sampled likelihood; see `from_end_poses`.

    Parameters
    ----------
    robot
        Its nominal geometry turned the commands into wheel speeds, and its largest acceleration
        shaped them. Its slip and true geometry are not looked at.
    geometry
        Estimate wheel gains and track too.

    Raises
    ------
    InputError
        Naming the file, and the line that is wrong.
    """
    nominal = DifferentialDrive(
        wheel_radius_m=robot.nominal.wheel_radius_m,
        track_m=robot.nominal.track_m,
        max_acceleration_mps2=robot.max_acceleration_mps2,
    )
    commands, ends = read_sheet(path)
    manoeuvres = [
        Manoeuvre(OpenLoop(segments=(command,)).profile(nominal), ends[case])
        for case, command in commands.items()
    ]
    try:
        return from_end_poses(manoeuvres, nominal, rng, geometry=geometry)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def read_sheet(path: Path) -> tuple[dict[str, tuple[float, float, float]], dict[str, Array]]:
    """Read the command (v, omega, duration) and the end poses (n, 3) of each case.

    Headings may be wrapped, as they are where an angle is published as a quaternion; see
    `unwrapped`.

    Raises
    ------
    InputError
        Naming the file and the line.
    """
    commands: dict[str, tuple[float, float, float]] = {}
    ends: dict[str, list[list[float]]] = {}
    for number, row in _rows(path):
        where, case = f"{path}:{number}", (row["case"] or "").strip()
        require(case, f"{where}: the case has no name")
        v, omega, duration_s = _numbers(row, COMMAND, where)
        for (name, most), value in zip(_MOST.items(), (v, omega, duration_s), strict=True):
            require(abs(value) <= most, f"{where}: {name} must be at most {most:g}, got {value:g}")
        require(
            duration_s > 0.0 and (v, omega) != (0.0, 0.0),
            f"{where}: the command must move the robot; remove rows that do not",
        )
        command = commands.setdefault(case, (v, omega, duration_s))
        require(
            command == (v, omega, duration_s),
            f"{where}: case {case} has another command above; give this one a name of its own",
        )
        ends.setdefault(case, []).append(_numbers(row, END_POSE, where))
    require(commands, f"{path}: holds no run; its columns are {','.join(COLUMNS)}")
    turns = {case: omega * duration_s for case, (_, omega, duration_s) in commands.items()}
    poses = {case: np.array(rows) for case, rows in ends.items()}
    headings = unwrap_headings([pose[:, 2] for pose in poses.values()], list(turns.values()))
    for pose, heading in zip(poses.values(), headings, strict=True):
        pose[:, 2] = heading
    return commands, poses


def unwrap_headings(headings: Sequence[Array], turns: Sequence[float]) -> list[Array]:
    """Add whole turns to the headings (n,) of each case that were wrapped.

    The cases with a commanded turn below pi say how far the robot turns for what it is commanded:
    the median of their ratios. From the other cases' commands that ratio predicts the heading, and
    of the headings that wrap to the same angle the nearest one is taken. A heading beyond +-pi was
    not wrapped and stays. (Wrapped headings are why puzzlebot2024 left out angular case 3.)
    """
    short = [
        h / turn for h, turn in zip(headings, turns, strict=True) if 1e-6 < abs(turn) < math.pi
    ]
    ratio = float(np.median(np.concatenate(short))) if short else 1.0
    whole_turn = 2.0 * math.pi
    return [
        heading
        + np.where(
            np.abs(heading) <= math.pi,
            whole_turn * np.round((ratio * turn - heading) / whole_turn),
            0.0,
        )
        for heading, turn in zip(headings, turns, strict=True)
    ]


def _rows(path: Path) -> Iterator[tuple[int, dict[str, str | None]]]:
    """Number and cells of each line."""
    try:
        with io.StringIO(read_text(path), newline="") as file:
            reader = csv.DictReader(file, restkey="more", skipinitialspace=True)
            given = [name.strip() for name in reader.fieldnames or ()]
            wanted, got = ",".join(COLUMNS), ",".join(given) or "none"
            require(
                sorted(given) == sorted(COLUMNS),
                f"{path}:1: the columns must be {wanted}, got {got}",
            )
            reader.fieldnames = given
            for row in reader:
                require(
                    "more" not in row, f"{path}:{reader.line_num}: more than {len(COLUMNS)} cells"
                )
                yield reader.line_num, row
    except csv.Error as error:
        raise InputError(f"{path}: cannot read ({error})") from error


def _numbers(row: dict[str, str | None], names: Sequence[str], where: str) -> list[float]:
    values = []
    for name in names:
        try:
            values.append(float(row[name] or ""))
        except ValueError:
            raise InputError(f"{where}: {name} must be a number, got {row[name]!r}") from None
        require(abs(values[-1]) < LARGEST, f"{where}: {name} must be finite, got {row[name]}")
    return values
