"""kr, kl, encoder gains and track from recorded runs, with 95 % intervals.

The wheel truth gives each interval's encoder error over the travel (`wheel_truth`). From end poses,
as in puzzlebot2024, candidates are simulated and their ends compared (`end_poses`).
"""

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
import scipy
from numpy.typing import ArrayLike

from experiments.calibration.end_poses import Manoeuvre, from_end_poses
from experiments.calibration.reference import spaced_rows
from experiments.calibration.result import CalibrationResult
from experiments.evaluation.statistics import Interval
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


SHORTEST_INTERVAL_S = 0.02


def from_wheel_truth(
    encoder_m: ArrayLike,
    ground_m: ArrayLike,
    turns_rad: ArrayLike | None = None,
    *,
    interval_s: float,
    geometry: bool = True,
) -> CalibrationResult:
    """Calibrate from the wheels' true travel.

    With e = encoder - ground, Var(e) = k |ds|, each wheel's estimate is
    k = sum(e^2) / sum(|ds|), the maximum likelihood for equal intervals. The mean of e^2 / |ds|
    would be another estimate, but there the intervals near rest, where |ds| is itself noise, weigh
    as much as all others and bias it, sixfold at the length of a tick. The interval of k is that of
    a chi-square with the effective degrees of freedom of the intervals, or with those that the
    scatter of e^2 shows, if fewer.

    With `geometry` the bias is regressed jointly, e = bias ds with weights 1 / |ds|, and its
    degree of freedom is subtracted; the track is regressed from the true turns.

    Parameters
    ----------
    encoder_m, ground_m
        (N, 2) increments of the right and left wheel over intervals, m.
    turns_rad
        (N,) true change of heading over the intervals, unwrapped, or None.
    interval_s
        Length of the intervals, at least 0.02 s.

    Raises
    ------
    InputError
        If intervals are too short, do not match, or have too little travel.
    """
    encoder, ground = np.asarray(encoder_m, float), np.asarray(ground_m, float)
    require(
        interval_s >= SHORTEST_INTERVAL_S - 1e-9,
        f"interval_s={interval_s:g} is too short: below {SHORTEST_INTERVAL_S:g} s the encoder "
        "noise inflates the travel; use longer intervals",
    )
    require(
        encoder.shape == ground.shape and encoder.ndim == 2 and encoder.shape[1] == 2,
        f"encoder and ground increments must both be (N, 2), got {encoder.shape} and "
        f"{ground.shape}",
    )
    (kr, right), (kl, left) = (_wheel(encoder[:, i], ground[:, i], geometry) for i in (0, 1))
    turned = geometry and turns_rad is not None
    track = _track(ground, np.asarray(turns_rad, float)) if turned else None
    return CalibrationResult("wheel_truth", kr, kl, right, left, track, len(encoder))


def _wheel(encoder_m: Array, ground_m: Array, geometry: bool) -> tuple[Interval, Interval | None]:
    """K of one wheel, m, and its bias."""
    travel = np.abs(ground_m)
    total_m = float(travel.sum())
    require(total_m > 0.0, "a wheel never rolled; calibrate from runs that move both wheels")
    dof = total_m**2 / float(np.sum(travel**2))  # the number of intervals, if they are equal
    require(
        dof >= 3.0,
        f"too little travel: {dof:.1f} effective intervals of wheel truth, at least 3 are "
        "needed; record longer runs",
    )
    error = encoder_m - ground_m
    bias = float(np.sum(error * np.sign(ground_m))) / total_m if geometry else 0.0
    residual = error - bias * ground_m
    left = dof - 1.0 if geometry else dof
    k = float(np.sum(residual**2)) / total_m * dof / left
    scatter = float(np.sum((residual**2 - k * travel) ** 2))
    shown = min(left, 2.0 * (k * total_m) ** 2 / scatter) if scatter > 0.0 else left
    low, high = shown * k / scipy.stats.chi2.ppf([0.975, 0.025], shown)
    half = float(scipy.stats.t.ppf(0.975, left)) * math.sqrt(k / total_m)
    of_bias = Interval(bias, bias - half, bias + half) if geometry else None
    return Interval(k, float(low), float(high)), of_bias


def _track(ground_m: Array, turns_rad: Array) -> Interval | None:
    """Track, m, by which the wheels' true difference turns the robot; None if it never turned."""
    difference, power = ground_m[:, 0] - ground_m[:, 1], float(np.sum(turns_rad**2))
    if power < 1e-6:
        return None
    track = float(difference @ turns_rad) / power
    residual = difference - track * turns_rad
    error = math.sqrt(float(np.sum((residual * turns_rad) ** 2))) / power
    half = float(scipy.stats.t.ppf(0.975, max(len(turns_rad) - 1, 1))) * error + 1e-9 * track
    return Interval(track, track - half, track + half)
