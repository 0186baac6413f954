"""The reference for a log's wheels: its truth, else its scans, else its landmarks."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from estimators.base import Prior
from estimators.landmarks.ekf_slam import EkfSlam
from estimators.laser.icp_odometry import IcpOdometry
from estimators.laser.scan_matching import FAILED
from experiments.evaluation.statistics import Interval, mean_interval
from experiments.runs.evaluate import OnStep, run_over
from sim import se2
from sim.arrays import Array, Ints
from sim.errors import require
from sim.recording import Recording, WheelLog
from sim.sensors import Laser, StereoCamera

INTERVAL_S = 1.0  # least length of the steps that the mount of a laser is found by
LARGEST_DELAY_S, _DELAY_STEP_S = 1.0, 0.01
N_PARTS = 8  # of the log, for the spread of a delay or of a noise
_LONGEST_GAP_S = 1.0  # of the truth
# Turns that show whether a laser is upside down: in all, each, and how many
_TURNED_RAD, _LEAST_TURN_RAD, _LEAST_TURNS = 6.0, 0.02, 10
_START = np.diag([1e-6] * 3)  # covariance of a known start


class Source(StrEnum):
    """What the wheels are compared with."""

    TRUTH = "truth"
    SCANS = "scans"
    LANDMARKS = "landmarks"


@dataclass(frozen=True)
class Reference:
    """Poses (N, 3) of the robot or of its laser, at stamps (N,) s.

    Attributes
    ----------
    joined
        (N - 1,) whether the motion from each to the next is known.
    """

    source: Source
    stamps: Array
    poses: Array
    joined: NDArray[np.bool_]


def names_of(recording: Recording, *kinds: type) -> list[str]:
    """Names of the sensors of these classes that have readings."""
    return [name for name in recording.logs if isinstance(recording.sensors[name], kinds)]


def reference_of(recording: Recording, on_step: OnStep = None) -> Reference:
    """Return what the wheels can be compared with: truth, else scans, else landmarks.

    `on_step` is called with the number of Frames done.

    Raises
    ------
    InputError
        If the log has none of them.
    """
    lasers, cameras = names_of(recording, Laser), names_of(recording, StereoCamera)
    if recording.truth is not None and len(recording.truth.stamps) > 2:
        stamps, poses = recording.truth.stamps, recording.truth.poses
        inside = (stamps >= recording.frame_stamps[0]) & (stamps <= recording.frame_stamps[-1])
        stamps, poses = stamps[inside], poses[inside]
        dense = len(stamps) > 2 and float(np.median(np.diff(stamps))) <= _LONGEST_GAP_S
        if dense or not lasers:
            of_laser = recording.config.get("truth_of") == "laser"  # chained scan matches
            source = Source.SCANS if of_laser else Source.TRUTH
            return Reference(source, stamps, poses, np.diff(stamps) <= _LONGEST_GAP_S)
    if lasers:
        return register_scans(recording, lasers[0], on_step)
    require(cameras, "the log has no truth, no scans and no landmarks to compare its wheels with")
    name = cameras[0]
    prior = Prior(recording.robot, recording.sensors, np.zeros(3), _START)
    # online, and gated: a batch that starts from wrong wheels and misread landmarks ends anywhere
    mapper = EkfSlam(kr=3e-3, kl=3e-3, gate_probability=1e-6, stereo=name)
    found, _ = run_over(recording, mapper, prior, np.random.default_rng(0), on_step=on_step)
    rows = np.flatnonzero(np.isin(found.stamps, recording.log(name).stamps))
    stamps = found.stamps[rows]
    return Reference(
        Source.LANDMARKS, stamps, found.means[rows], np.diff(stamps) <= 2.0 * INTERVAL_S
    )


def register_scans(
    recording: Recording, name: str, on_step: OnStep = None, *, guessed: bool = True
) -> Reference:
    """Poses of a laser by registering each of its scans to the one before.

    What moves is the laser, as the log has its mount on the robot. `guessed`: registrations start
    from the wheels.
    """
    prior = Prior(recording.robot, recording.sensors, np.zeros(3), _START)
    matcher = IcpOdometry(
        kr=3e-3,
        kl=3e-3,
        sigma_range_m=0.03,
        reference="previous",
        laser=name,
        use_odometry_guess=guessed,
    )
    keep = ("registration_status",)
    found, _ = run_over(recording, matcher, prior, np.random.default_rng(0), keep, on_step)
    rows = np.flatnonzero(np.isin(found.stamps, recording.log(name).stamps))
    sound = [found.extras["registration_status"][i] not in FAILED for i in rows[1:]]
    return Reference(Source.SCANS, found.stamps[rows], found.means[rows], np.array(sound, bool))


def mirror(recording: Recording, names: Sequence[str]) -> Recording:
    """Return the recording with these lasers mounted upside down."""
    for name in names:
        log, laser = recording.log(name), recording.sensor(name, Laser)
        mount = dataclasses.replace(laser.mount, yaw_rad=-laser.mount.yaw_rad)
        ranges = log["ranges_m"][:, ::-1].copy()
        log = dataclasses.replace(log, values={**log.values, "ranges_m": ranges})
        recording = recording.with_log(name, log, dataclasses.replace(laser, mount=mount))
    return recording


def is_mirrored(recording: Recording, name: str) -> bool:
    """Whether a laser turns against the wheels, by scans over the log's first turns.

    It does if its scans, registered to one another, turn as the wheels do once they are mirrored,
    and not before. Wheels whose sides are swapped look alike: then both turn the other way.
    """
    stamps = recording.log(name).stamps
    wheels = recording.wheels.at(stamps)
    turns = np.abs(np.diff(wheels[:, 0] - wheels[:, 1])) / recording.robot.track_m
    enough = np.flatnonzero(np.cumsum(turns) > _TURNED_RAD)
    last = stamps[min(int(enough[0]) + 1 if len(enough) else len(stamps) - 1, len(stamps) - 1)]
    part = recording.cut(int(np.searchsorted(recording.frame_stamps, last, side="right")))
    if len(part.frame_stamps) < 2:
        return False
    off = []
    for one in (part, mirror(part, [name])):
        found = register_scans(one, name, guessed=False)
        at = recording.wheels.at(found.stamps)
        by_wheels = np.diff(at[:, 0] - at[:, 1]) / recording.robot.track_m
        by_scans = se2.wrap(np.diff(found.poses[:, 2]))
        turned = found.joined & (np.abs(by_wheels) > _LEAST_TURN_RAD)
        if turned.sum() < _LEAST_TURNS:
            return False
        off.append(float(np.median(np.abs(by_scans - by_wheels)[turned])))
    return off[1] < 0.5 * off[0]


def wheel_delay_s(wheels: WheelLog, reference: Reference) -> Interval:
    """What to add to the stamps of the wheels so that they turn when the reference turns.

    The delay at which the turns of both correlate best, over steps of at least a tenth of a second;
    the interval is that of the mean over eight parts of the log, and all that was tried where fewer
    than two of these show a delay.
    """
    rows = spaced_rows(reference.stamps, 0.1)
    stamps, heading = reference.stamps[rows], np.unwrap(reference.poses[rows, 2])
    joined = np.array([reference.joined[a:b].all() for a, b in pairwise(rows)], bool)
    joined &= np.diff(stamps) < 2.0
    turns = np.diff(heading)
    delays = np.arange(-LARGEST_DELAY_S, LARGEST_DELAY_S + 1e-9, _DELAY_STEP_S)
    by_wheels = [np.diff(np.diff(wheels.at(stamps - d), axis=1)[:, 0]) for d in delays]
    rolled = -np.array(by_wheels)

    def best(part: Ints) -> float:
        if len(part) < 10 or np.ptp(turns[part]) == 0.0:
            return math.nan
        with np.errstate(invalid="ignore"):
            likeness = [np.corrcoef(turns[part], r[part])[0, 1] for r in rolled]
        if not np.isfinite(likeness).any():
            return math.nan
        return float(delays[int(np.nanargmax(likeness))])

    known = np.flatnonzero(joined)
    require(len(known) >= 10, "too few motions of the reference to find the wheels' delay")
    whole = best(known)
    require(math.isfinite(whole), "the robot never turned; a calibration needs turns and straights")
    parts = np.array([best(part) for part in np.array_split(known, N_PARTS)])
    shown = parts[np.isfinite(parts)]
    spread = mean_interval(shown) if len(shown) > 1 else None
    half = LARGEST_DELAY_S if spread is None else (spread.high - spread.low) / 2.0
    whole = round(whole / _DELAY_STEP_S) * _DELAY_STEP_S  # no rounding errors of the steps
    return Interval(whole, whole - half, whole + half)


def spaced_rows(stamps: Array, min_s: float) -> Ints:
    """Rows of stamps (N,) that are at least so far apart."""
    rows: list[int] = []
    for row, stamp in enumerate(stamps):
        if not rows or stamp - stamps[rows[-1]] >= min_s - 1e-9:
            rows.append(row)
    return np.array(rows, np.int64)
