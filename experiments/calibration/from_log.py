"""A real robot's calibration from one of its logs: wheels, delays, slip, and the sensor's noise.

The wheels are compared with a reference of the robot's motion: the log's truth if it has one, else
the registrations of its scans, else the landmarks that it saw (EKF-SLAM, with wheels that count for
little). What is found against scans or landmarks is in their metres.
"""

import dataclasses
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from experiments.calibration.logs import calibrate_wheels
from experiments.calibration.reference import (
    INTERVAL_S,
    Reference,
    Source,
    is_mirrored,
    mirror,
    names_of,
    reference_of,
    register_scans,
    spaced_rows,
    wheel_delay_s,
)
from experiments.calibration.sensor_noise import MAD, camera_noise, laser_noise
from experiments.calibration.slip import BLOCK_S, N_RESAMPLES, slip_of_blocks
from experiments.evaluation.statistics import Interval
from experiments.runs.calibration import Calibration, SensorBelief, Wheels
from experiments.runs.evaluate import OnStep
from sim import se2
from sim.arrays import Array, Ints
from sim.errors import require
from sim.formats.khepera import WheelLaserLog
from sim.recording import Recording, WheelLog
from sim.sensors import Laser, StereoCamera

_MIN_BLOCKS = 10
_VAGUE = 5.0  # factor between the ends of an interval, from which on it says little


@dataclass(frozen=True)
class Residuals:
    """What a calibration leaves unexplained.

    Attributes
    ----------
    block_stamps, turn_rad, forward_m, path_m
        (B,) end of each block, s; turn and advance less those of the wheels; (B, 2) wheel travel.
    range_m, range_error_m, bearing_rad, bearing_error_rad
        (K,) of the sensor; empty where not known. A laser has errors of ranges alone.
    """

    block_stamps: Array
    turn_rad: Array
    forward_m: Array
    path_m: Array
    range_m: Array
    range_error_m: Array
    bearing_rad: Array
    bearing_error_rad: Array


@dataclass(frozen=True)
class LogCalibration:
    """A calibration, with the 95 % interval of each number by name, and what is left.

    Attributes
    ----------
    geometry_covariance
        (3, 3) of the gains of the right and left wheel and the track, m.
    """

    source: Source
    calibration: Calibration
    intervals: dict[str, Interval]
    residuals: Residuals
    geometry_covariance: Array

    def as_text(self) -> str:
        """One line a number."""
        lines = [f"against the {self.source} of the log"]
        for name, found in self.intervals.items():
            bounds = f"[{found.low:.4g}, {found.high:.4g}]"
            vague = 0.0 < _VAGUE * found.low < found.high
            remark = "  hardly known from these motions" if vague else ""
            lines.append(f"  {name:<28} {found.value:12.5g} {bounds:>26}{remark}")
        return "\n".join(lines)


def calibrate_log(
    recording: Recording, until_s: float | None = None, on_step: OnStep = None
) -> LogCalibration:
    """Calibrate a robot by the first `until_s` of a log, or by all of it.

    `on_step` is called with the number of Frames done.

    Raises
    ------
    InputError
        If there is nothing to compare the wheels with, or too little of it.
    """
    part = recording if until_s is None else _cut(recording, until_s)
    mirrored = [name for name in names_of(part, Laser) if is_mirrored(part, name)]
    part = mirror(part, mirrored)
    found = calibrate_against(reference_of(part, on_step), part)
    sensors = dict(found.calibration.sensors)
    for name in mirrored:
        sensors[name] = dataclasses.replace(sensors.get(name, SensorBelief()), mirrored=True)
    calibration = dataclasses.replace(found.calibration, sensors=sensors)
    return dataclasses.replace(found, calibration=calibration)


def moved_base(logged: Recording, calibrated: Recording) -> Array:
    """Pose (3,) of the log's base_link in the calibrated one: the first laser is where it was."""
    lasers = names_of(logged, Laser)
    if not lasers:
        return np.zeros(3)
    before, after = (one.sensor(lasers[0], Laser).mount.pose for one in (logged, calibrated))
    return se2.compose(after, se2.inverse(before))


def calibrate_against(reference: Reference, part: Recording) -> LogCalibration:
    """Calibrate a robot by a log whose reference is at hand.

    Raises
    ------
    InputError
        If there is too little of it.
    """
    delay = wheel_delay_s(part.wheels, reference)
    shifted = WheelLog(part.wheels.stamps + delay.value, part.wheels.position_m)
    mount, mount_intervals = np.zeros(3), {}
    if reference.source is Source.SCANS:  # what was registered is the motion of the laser
        fit = calibrate_wheels(_steps(shifted, reference, INTERVAL_S)[0], 1.0, part.robot.track_m)
        mount = fit.values[3:]
        mount_intervals = {"x_m": fit.laser_x_m, "y_m": fit.laser_y_m, "yaw_rad": fit.laser_yaw_rad}
    blocks = _blocks(shifted, reference, mount)
    geometry = _geometry(blocks)
    rng = np.random.default_rng(0)
    n = len(blocks.turn_rad)
    spread = np.array([_geometry(blocks.of(rng.integers(n, size=n))) for _ in range(N_RESAMPLES)])
    bounds = np.quantile(spread, [0.025, 0.975], axis=0)
    right, left_one, track_m = (
        Interval(*map(float, values)) for values in zip(geometry, *bounds, strict=True)
    )
    path = np.abs(blocks.travel_m) * geometry[:2]
    rolled = blocks.rolled_m * geometry[:2]
    turn = blocks.turn_rad - (rolled[:, 0] - rolled[:, 1]) / geometry[2]
    forward = blocks.forward_m - rolled.mean(axis=1)
    slip, slip_intervals = slip_of_blocks(blocks.stamps, turn * geometry[2], forward, path, rng)
    intervals = {
        "wheels.gain_right": right,
        "wheels.gain_left": left_one,
        "wheels.track_m": track_m,
        "wheels.delay_s": delay,
        **slip_intervals,
    }
    wheels = Wheels(
        gain_right=right.value,
        gain_left=left_one.value,
        track_m=track_m.value,
        delay_s=delay.value,
    )
    sensors: dict[str, SensorBelief] = {}
    left = [np.zeros(0)] * 4
    lasers, cameras = names_of(part, Laser), names_of(part, StereoCamera)
    if lasers and reference.source is not Source.LANDMARKS:
        name, laser = lasers[0], part.sensor(lasers[0], Laser)
        found, by_scans = SensorBelief(), reference.source is Source.SCANS
        if by_scans:
            # the reference moves the laser as the log mounts it; the mount found comes before that
            x, y, yaw = moved = se2.compose(mount, laser.mount.pose)
            found = SensorBelief(x_m=float(x), y_m=float(y), yaw_rad=float(yaw))
            for (key, known), value, by in zip(
                mount_intervals.items(), moved, moved - mount, strict=True
            ):
                interval = Interval(float(value), known.low + float(by), known.high + float(by))
                intervals[f"sensors.{name}.{key}"] = interval
        # a truth errs from scan to scan by more than the laser does
        scans = reference if by_scans else register_scans(part, name)
        noise, share, left = laser_noise(part, name, scans)
        sensors[name] = dataclasses.replace(found, sigma_range_m=noise.value)
        intervals |= {f"sensors.{name}.sigma_range_m": noise, f"{name}: outliers": share}
    if part.world is not None and any(part.sensor(n, StereoCamera).identifies for n in cameras):
        name = cameras[0]
        sensors[name], of_camera, left = camera_noise(part, name, reference)
        intervals |= of_camera
    return LogCalibration(
        reference.source,
        Calibration(wheels, slip, sensors),
        intervals,
        Residuals(blocks.stamps, turn, forward, path, *left),
        np.cov(spread.T),
    )


def _cut(recording: Recording, until_s: float) -> Recording:
    """Return the Frames and the truth of a log's first seconds."""
    require(until_s > 0.0, f"the part must be a positive number of seconds, got {until_s:g}")
    end = recording.frame_stamps[0] + until_s
    n = int(np.searchsorted(recording.frame_stamps, end))
    require(n >= 2, f"the first {until_s:g} s: no Frames in so short a part")
    truth = recording.truth
    if truth is not None:
        kept = truth.stamps <= end
        truth = dataclasses.replace(
            truth,
            stamps=truth.stamps[kept],
            poses=truth.poses[kept],
            wheel_travel_m=truth.wheel_travel_m[kept[: len(truth.wheel_travel_m)]],
        )
    return dataclasses.replace(recording.cut(n), truth=truth)


def _steps(wheels: WheelLog, reference: Reference, min_s: float) -> tuple[WheelLaserLog, Array]:
    """Wheel travel and the reference's motion over steps of at least so long, and their ends."""
    rows = spaced_rows(reference.stamps, min_s)
    pairs = [(a, b) for a, b in pairwise(rows) if reference.joined[a:b].all()]
    require(
        len(pairs) >= 3 * _MIN_BLOCKS,
        f"only {len(pairs)} motions of the wheels have a reference; give a longer log",
    )
    first, second = np.array(pairs).T
    stamps, travel = reference.stamps, wheels.at(reference.stamps)
    steps = WheelLaserLog(
        stamps[second] - stamps[first],
        2.0 * (travel[second] - travel[first]),  # of diameter 1, so that what is found are gains
        se2.between(reference.poses[first], reference.poses[second]),
    )
    return steps, stamps[second]


@dataclass(frozen=True)
class _Blocks:
    """Sums over blocks of about `BLOCK_S` in which the robot moved.

    Attributes
    ----------
    stamps
        (B,) s, their ends.
    turn_rad, forward_m
        (B,) of the reference.
    rolled_m, travel_m
        (B, 2) of the wheels as logged: net, and the sum of sizes.
    """

    stamps: Array
    turn_rad: Array
    forward_m: Array
    rolled_m: Array
    travel_m: Array

    def of(self, rows: Ints) -> "_Blocks":
        """Return these blocks."""
        return _Blocks(*(values[rows] for values in vars(self).values()))


def _blocks(wheels: WheelLog, reference: Reference, mount: Array) -> _Blocks:
    """Sum the motion of base_link and of the wheels over blocks.

    Over a block the robot need not drive an arc: turns and advances of short steps are summed.
    """
    steps, ends = _steps(wheels, reference, 0.1)
    moved = se2.compose(se2.compose(mount, steps.laser_motion), se2.inverse(mount))
    turn, forward = se2.wrap(moved[:, 2]), se2.log(moved)[:, 0]
    rolled = steps.rolled_rad / 2.0
    rows = [0]
    starts = ends - steps.durations_s
    for i in range(1, len(ends) + 1):
        # a block ends when it is long enough, or where the reference has a gap
        gap = i < len(ends) and starts[i] > ends[i - 1] + 1e-6
        if i == len(ends) or gap or ends[i - 1] - starts[rows[-1]] >= BLOCK_S:
            rows.append(i)
    first, last = np.array(rows[:-1]), np.array(rows[1:]) - 1
    sums = [np.add.reduceat(v, first, axis=0) for v in (turn, forward, rolled, np.abs(rolled))]
    long = ends[last] - starts[first] >= 0.5 * BLOCK_S
    path = sums[3].sum(axis=1)
    kept = long & (path > 0.1 * np.median(path[long]) if long.any() else long)
    require(
        int(kept.sum()) >= _MIN_BLOCKS,
        f"only {int(kept.sum())} blocks of {BLOCK_S:g} s in which the robot moved have a "
        "reference; give a longer log",
    )
    return _Blocks(ends[last], *sums).of(np.flatnonzero(kept))


def _geometry(blocks: _Blocks) -> Array:
    """Gains of the right and left wheel, and track, (3,), by robust least squares.

    turn = (a_r W_r - a_l W_l) / track, advance = (a_r W_r + a_l W_l) / 2.
    """
    per_track = _robust_fit(blocks.rolled_m * [1.0, -1.0], blocks.turn_rad)
    mean = blocks.rolled_m @ per_track / 2.0
    track_m = float(_robust_fit(mean[:, None], blocks.forward_m)[0])
    return np.append(per_track * track_m, track_m)


def _robust_fit(rows: Array, values: Array) -> Array:
    """Solve rows (N, K) x = values (N,) with Huber's loss, by weighted least squares again."""
    weights = np.ones(len(values))
    for _ in range(15):
        root = np.sqrt(weights)
        found = np.linalg.lstsq(rows * root[:, None], values * root, rcond=None)[0]
        off = np.abs(values - rows @ found)
        turns_at = 1.5 * MAD * float(np.median(off)) + 1e-12
        weights = np.minimum(1.0, turns_at / np.maximum(off, 1e-15))
    return np.asarray(found)
