"""kr, kl, encoder gains and track from recorded runs, with 95 % intervals.

The wheel truth gives each interval's encoder error over the travel (`wheel_truth`). From end poses,
as in puzzlebot2024, candidates are simulated and their ends compared (`end_poses`).
"""

from collections.abc import Sequence
from typing import Literal

import numpy as np

from experiments.calibration.end_poses import Manoeuvre, from_end_poses
from experiments.calibration.reference import spaced_rows
from experiments.calibration.result import CalibrationResult
from experiments.calibration.wheel_truth import from_wheel_truth
from sim import se2
from sim.arrays import Array
from sim.errors import InputError, require
from sim.recording import Recording
from sim.robot.base import TICK_S
from sim.robot.drive import DifferentialDrive


def calibrate_recordings(
    recordings: Sequence[Recording],
    method: Literal["wheel_truth", "end_poses"] = "wheel_truth",
    *,
    geometry: bool = True,
    interval_s: float = 0.05,
    rng: np.random.Generator | None = None,
) -> CalibrationResult:
    """Calibrate from recordings.

    Parameters
    ----------
    recordings
        For `wheel_truth`, any runs whose truth includes the wheels' travel. For `end_poses`,
        repetitions of open-loop manoeuvres, grouped by their commands.
    interval_s
        Shortest interval over which wheel travel is netted.
    rng
        For the samples of `end_poses`; seeded with 0 if None.

    Raises
    ------
    InputError
        If the truth is missing, runs are not repeated, or there is too little travel.
    """
    require(recordings, "no recordings to calibrate from; give at least one")
    if method == "wheel_truth":
        parts = [_wheel_intervals(r, i, interval_s) for i, r in enumerate(recordings)]
        encoder, ground, turns = (np.concatenate(p) for p in zip(*parts, strict=True))
        return from_wheel_truth(encoder, ground, turns, interval_s=interval_s, geometry=geometry)
    require(method == "end_poses", f"method must be wheel_truth or end_poses, got {method!r}")
    groups: dict[bytes, tuple[Array, list[Array]]] = {}
    for i, recording in enumerate(recordings):
        profile = _command_profile(recording, i)
        groups.setdefault(profile.tobytes(), (profile, []))[1].append(end_pose(recording, i))
    require(
        min(len(ends) for _, ends in groups.values()) >= 2,
        "end poses need open-loop runs with the same commands, at least 2 of each; "
        "give repetitions, or use the wheel truth",
    )
    manoeuvres = [Manoeuvre(profile, np.array(ends)) for profile, ends in groups.values()]
    nominal = DifferentialDrive(**vars(recordings[0].robot))
    return from_end_poses(manoeuvres, nominal, rng or np.random.default_rng(0), geometry=geometry)


def _wheel_intervals(recording: Recording, i: int, interval_s: float) -> tuple[Array, Array, Array]:
    """Increments of encoder (N, 2), ground (N, 2) and heading (N,) over netted intervals."""
    truth, wheels = recording.truth, recording.wheels
    if truth is None or len(truth.wheel_travel_m) == 0:
        raise InputError(
            f"recording {i} has no true wheel travel; record it in simulation, or calibrate from "
            "end poses; of a real log `estima calibrate` writes a .yaml file"
        )
    known = (truth.stamps >= wheels.stamps[0] - 1e-9) & (truth.stamps <= wheels.stamps[-1] + 1e-9)
    rows = np.flatnonzero(known)
    rows = rows[spaced_rows(truth.stamps[rows], interval_s)]
    require(len(rows) >= 2, f"recording {i} is shorter than one interval of {interval_s:g} s")
    encoder = [np.interp(truth.stamps[rows], wheels.stamps, way) for way in wheels.position_m.T]
    heading = np.unwrap(truth.poses[:, 2])[rows]
    return np.diff(encoder).T, np.diff(truth.wheel_travel_m[rows], axis=0), np.diff(heading)


def _command_profile(recording: Recording, i: int) -> Array:
    """Commanded body velocities (N, 2) at ticks."""
    log = recording.commands
    if log is None or len(log.stamps) == 0:
        raise InputError(
            f"recording {i} has no commands; end poses need them: record it in "
            "simulation, or use the wheel truth"
        )
    ticks = np.arange(round(recording.duration_s / TICK_S))
    middles = recording.frame_stamps[0] + (ticks + 0.5) * TICK_S
    rows = np.searchsorted(log.stamps, middles, side="right") - 1
    return np.where(rows[:, None] >= 0, log.velocity[np.maximum(rows, 0)], 0.0)


def end_pose(recording: Recording, i: int = 0) -> Array:
    """True end pose (3,) of recording number i relative to its start; heading unwrapped."""
    if recording.truth is None or len(recording.truth.poses) < 2:
        raise InputError(f"recording {i} has no true poses to calibrate from")
    poses = recording.truth.poses
    x, y, _ = se2.between(poses[0], poses[-1])
    return np.array([x, y, np.unwrap(poses[:, 2])[-1] - poses[0, 2]])
