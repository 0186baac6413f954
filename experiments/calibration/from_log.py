"""A real robot's calibration from one of its logs: wheels, delays, slip, and the sensor's noise.

The wheels are compared with a reference of the robot's motion: the log's truth if it has one, else
the registrations of its scans, else the landmarks that it saw (EKF-SLAM, with wheels that count for
little). What is found against scans or landmarks is in their metres.
"""

import dataclasses
import math
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from estimators.base import Prior
from estimators.base import run as run_estimator
from estimators.landmarks.ekf_slam import EkfSlam
from estimators.laser.icp_odometry import IcpOdometry
from estimators.laser.scan_matching import FAILED
from experiments.calibration.logs import calibrate_wheels, slip_law
from experiments.evaluation.statistics import Interval, mean_interval, share_interval
from experiments.runs.calibration import Calibration, SensorBelief, Slip, Wheels
from sim import se2
from sim.arrays import Array, Ints
from sim.errors import InputError, require
from sim.formats.khepera import WheelLaserLog
from sim.recording import Recording, WheelLog
from sim.sensors import Laser, StereoCamera

INTERVAL_S = 1.0  # least length of the steps that the mount of a laser is found by
BLOCK_S = 4.0  # over which errors of the wheels are summed: stamps and starts cancel
LARGEST_DELAY_S, _DELAY_STEP_S = 1.0, 0.01
_N_PARTS = 8  # of the log, for the spread of a delay
_FEWEST_BLOCKS = 10
_RESAMPLES = 200
_MOST_LASTING = 10.0  # blocks; slip that lasts longer is a gain
_NO_SLIP_M = 1e-12  # kr or kl that is at its bound of zero
_OUTLIER = 6.0  # in robust standard deviations
_LONGEST_GAP_S = 1.0  # of the truth
_VAGUE = 5.0  # factor between the ends of an interval, from which on it says little
_START = np.diag([1e-6] * 3)  # covariance of a known start
S = TypeVar("S")
MAD = 1.4826  # standard deviation of a normal over its median absolute deviation


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


@dataclass(frozen=True)
class Residuals:
    """What a calibration leaves unexplained.

    Attributes
    ----------
    block_stamps, turn_rad, forward_m, path_m
        (B,) end of each block, s; turn and advance less those of the wheels; (B, 2) wheel travel.
    range_m, range_error_m, bearing_rad, bearing_error_rad
        (K,) of the sensor; empty where not known. The errors of a laser are of ranges alone.
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
class Found:
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


def calibrate_log(recording: Recording, until_s: float | None = None) -> Found:
    """Calibrate a robot by the first `until_s` of a log, or by all of it.

    Raises
    ------
    InputError
        If there is nothing to compare the wheels with, or too little of it.
    """
    part = recording if until_s is None else _cut(recording, until_s)
    return calibrate_against(reference_of(part), part)


def calibrate_against(reference: Reference, part: Recording) -> Found:
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
    spread = np.array([_geometry(blocks.of(rng.integers(n, size=n))) for _ in range(_RESAMPLES)])
    bounds = np.quantile(spread, [0.025, 0.975], axis=0)
    right, left_one, track_m = (
        Interval(*map(float, values)) for values in zip(geometry, *bounds, strict=True)
    )
    path = np.abs(blocks.travel_m) * geometry[:2]
    rolled = blocks.rolled_m * geometry[:2]
    turn = blocks.turn_rad - (rolled[:, 0] - rolled[:, 1]) / geometry[2]
    forward = blocks.forward_m - rolled.mean(axis=1)
    slip, slip_intervals = _slip(blocks.stamps, turn * geometry[2], forward, path, rng)
    intervals = {
        "wheels.gain_right": right,
        "wheels.gain_left": left_one,
        "wheels.track_m": track_m,
        "wheels.delay_s": delay,
        **slip_intervals,
    }
    wheels = Wheels(right.value, left_one.value, track_m.value, delay.value)
    sensors: dict[str, SensorBelief] = {}
    left = [np.zeros(0)] * 4
    lasers = [name for name in part.logs if isinstance(part.sensors[name], Laser)]
    if reference.source is Source.SCANS:
        name, laser = _of_kind(part, Laser)
        # the reference moves the laser as the log mounts it; the mount found comes before that
        x, y, yaw = se2.compose(mount, laser.mount.pose)
        noise, share, left = _laser_noise(part, name, reference)
        sensors[name] = SensorBelief(float(x), float(y), float(yaw), sigma_range_m=noise.value)
        for key, value, of_mount in zip(("x_m", "y_m", "yaw_rad"), (x, y, yaw), mount, strict=True):
            found, by = mount_intervals[key], float(value - of_mount)
            moved = Interval(float(value), found.low + by, found.high + by)
            intervals[f"sensors.{name}.{key}"] = moved
        intervals |= {f"sensors.{name}.sigma_range_m": noise, f"{name}: outliers": share}
    elif lasers and reference.source is Source.TRUTH:
        # a truth errs from scan to scan by more than the laser does
        noise, share, left = _laser_noise(part, lasers[0], _registered(part, lasers[0]))
        sensors[lasers[0]] = SensorBelief(sigma_range_m=noise.value)
        intervals |= {f"sensors.{lasers[0]}.sigma_range_m": noise, f"{lasers[0]}: outliers": share}
    if part.world is not None and any(
        isinstance(sensor, StereoCamera) and sensor.identifies for sensor in part.sensors.values()
    ):
        name, camera = _of_kind(part, StereoCamera)
        belief, of_camera, left = _camera(part, name, camera, reference)
        sensors[name] = belief
        intervals |= of_camera
    return Found(
        reference.source,
        Calibration(wheels, slip, sensors),
        intervals,
        Residuals(blocks.stamps, turn, forward, path, *left),
        np.cov(spread.T),
    )


def _cut(recording: Recording, until_s: float) -> Recording:
    """Return the Frames and the truth of a log's first seconds."""
    require(until_s > 0.0, f"--until must be a positive number of seconds, got {until_s:g}")
    end = recording.frame_stamps[0] + until_s
    n = int(np.searchsorted(recording.frame_stamps, end))
    require(n >= 2, f"--until={until_s:g}: no Frames in so short a part")
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


def _of_kind(recording: Recording, kind: type[S]) -> tuple[str, S]:
    """Name and sensor of the first sensor of a class that has readings."""
    for name in recording.logs:
        sensor = recording.sensors[name]
        if isinstance(sensor, kind):
            return name, sensor
    raise InputError(f"the log has no readings of a {kind.__name__}")


def reference_of(recording: Recording) -> Reference:
    """Return what the wheels can be compared with: truth, else scans, else landmarks.

    Raises
    ------
    InputError
        If the log has none of them.
    """
    has_laser, has_camera = (
        any(isinstance(recording.sensors[name], kind) for name in recording.logs)
        for kind in (Laser, StereoCamera)
    )
    if recording.truth is not None and len(recording.truth.stamps) > 2:
        stamps, poses = recording.truth.stamps, recording.truth.poses
        inside = (stamps >= recording.frame_stamps[0]) & (stamps <= recording.frame_stamps[-1])
        stamps, poses = stamps[inside], poses[inside]
        dense = len(stamps) > 2 and float(np.median(np.diff(stamps))) <= _LONGEST_GAP_S
        if dense or not has_laser:
            return Reference(Source.TRUTH, stamps, poses, np.diff(stamps) <= _LONGEST_GAP_S)
    if has_laser:
        return _registered(recording, _of_kind(recording, Laser)[0])
    require(
        has_camera,
        "the log has no truth, no scans and no landmarks to compare its wheels with",
    )
    name, _ = _of_kind(recording, StereoCamera)
    prior = Prior(recording.robot, recording.sensors, np.zeros(3), _START)
    # online, and gated: a batch that starts from wrong wheels and misread landmarks ends anywhere
    mapper = EkfSlam(kr=3e-3, kl=3e-3, errors="invariant", gate_probability=1e-6, stereo=name)
    found = run_estimator(mapper, recording, prior, np.random.default_rng(0))
    rows = np.flatnonzero(np.isin(found.stamps, recording.log(name).stamps))
    stamps = found.stamps[rows]
    return Reference(
        Source.LANDMARKS, stamps, found.means[rows], np.diff(stamps) <= 2.0 * INTERVAL_S
    )


def _registered(recording: Recording, name: str) -> Reference:
    """Poses of a laser by registering each of its scans to the one before.

    What moves is the laser, as the log has its mount on the robot.
    """
    prior = Prior(recording.robot, recording.sensors, np.zeros(3), _START)
    matcher = IcpOdometry(kr=3e-3, kl=3e-3, sigma_range_m=0.03, reference="previous", laser=name)
    keep = ("registration_status",)
    found = run_estimator(matcher, recording, prior, np.random.default_rng(0), keep)
    rows = np.flatnonzero(np.isin(found.stamps, recording.log(name).stamps))
    sound = [found.extras["registration_status"][i] not in FAILED for i in rows[1:]]
    return Reference(Source.SCANS, found.stamps[rows], found.means[rows], np.array(sound, bool))


def _travel_at(wheels: WheelLog, stamps: Array) -> Array:
    """Wheel positions (N, 2) interpolated at stamps (N,), m."""
    return np.stack([np.interp(stamps, wheels.stamps, p) for p in wheels.position_m.T], axis=1)


def wheel_delay_s(wheels: WheelLog, reference: Reference) -> Interval:
    """What to add to the stamps of the wheels so that they turn when the reference turns.

    The delay at which the turns of both correlate best, over steps of at least a tenth of a second;
    the interval is that of the mean over eight parts of the log.
    """
    rows = _spaced(reference.stamps, 0.1)
    stamps, heading = reference.stamps[rows], np.unwrap(reference.poses[rows, 2])
    joined = np.array([reference.joined[a:b].all() for a, b in pairwise(rows)])
    joined &= np.diff(stamps) < 2.0
    turns = np.diff(heading)
    delays = np.arange(-LARGEST_DELAY_S, LARGEST_DELAY_S + 1e-9, _DELAY_STEP_S)
    by_wheels = [np.diff(np.diff(_travel_at(wheels, stamps - d), axis=1)[:, 0]) for d in delays]
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
    parts = np.array([best(part) for part in np.array_split(known, _N_PARTS)])
    spread = mean_interval(parts[np.isfinite(parts)])
    half = (spread.high - spread.low) / 2.0
    whole = round(whole / _DELAY_STEP_S) * _DELAY_STEP_S  # no rounding errors of the steps
    return Interval(whole, whole - half, whole + half)


def _spaced(stamps: Array, least_s: float) -> Ints:
    """Rows of stamps (N,) that are at least so far apart."""
    rows = [0]
    for row in range(1, len(stamps)):
        if stamps[row] - stamps[rows[-1]] >= least_s - 1e-9:
            rows.append(row)
    return np.array(rows)


def _steps(wheels: WheelLog, reference: Reference, least_s: float) -> tuple[WheelLaserLog, Array]:
    """Wheel travel and the reference's motion over steps of at least so long, and their ends."""
    rows = _spaced(reference.stamps, least_s)
    pairs = [(a, b) for a, b in pairwise(rows) if reference.joined[a:b].all()]
    require(
        len(pairs) >= 3 * _FEWEST_BLOCKS,
        f"only {len(pairs)} motions of the wheels have a reference; give a longer log",
    )
    first, second = np.array(pairs).T
    stamps, travel = reference.stamps, _travel_at(wheels, reference.stamps)
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
        int(kept.sum()) >= _FEWEST_BLOCKS,
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


def _slip(
    stamps: Array, off_m: Array, forward_m: Array, path_m: Array, rng: np.random.Generator
) -> tuple[Slip, dict[str, Interval]]:
    """kr, kl by the turns of blocks, times the track, and the forward slip that they leave.

    Both get what they have in common unless the log tells them apart: blocks in which both wheels
    roll alike say nothing of either, and a kr of zero would be believed. Forward slip lasts if the
    errors of a block and the next are alike.
    """
    travel_m = path_m.mean(axis=1)
    joined = np.append(np.diff(stamps) < 1.5 * BLOCK_S, False)
    product = np.where(joined, forward_m * np.roll(forward_m, -1), 0.0)

    def law(rows: Ints, together: bool = False) -> Array:
        kr, kl = slip_law(off_m[rows] ** 2, path_m[rows])
        if together:
            kr = kl = np.sum(off_m[rows] ** 2) / np.sum(path_m[rows])
        more = forward_m[rows] ** 2 - path_m[rows] @ [kr, kl] / 4.0
        variance = max(float(np.mean(more)), 0.0)
        follows = rows[joined[rows]]
        alike = np.mean(product[follows]) / variance if variance and len(follows) else 0.0
        return np.array([kr, kl, variance / np.mean(travel_m[rows]), alike])

    n = len(path_m)
    every = np.arange(n)
    picks = rng.integers(n, size=(_RESAMPLES, n))
    apart = np.array([law(pick) for pick in picks])
    difference = np.quantile(apart[:, 0] - apart[:, 1], [0.025, 0.975])
    none_at_zero = float(law(every)[:2].min()) > _NO_SLIP_M
    together = bool(difference[0] <= 0.0 <= difference[1]) or not none_at_zero
    spread = np.array([law(pick, True) for pick in picks]) if together else apart
    lasts = float(np.quantile(spread[:, 3], 0.025)) > 0.0
    block_m = float(np.mean(travel_m))

    def named(values: Array, blocks: float) -> Array:
        """kr, kl, forward slip per metre in the long run, and its length, m."""
        share = 1.0 - blocks * (1.0 - math.exp(-1.0 / blocks)) if blocks else 1.0
        return np.array([*values[:2], values[2] / share, blocks * block_m])

    lengths = [lasting_blocks(values[3]) for values in spread]
    found_of = [named(v, a if lasts else 0.0) for v, a in zip(spread, lengths, strict=True)]
    low, high = np.quantile(found_of, [0.025, 0.975], axis=0)
    if not lasts:
        high[3] = np.quantile(lengths, 0.975) * block_m
    whole = law(every, together)
    values = named(whole, lasting_blocks(whole[3]) if lasts else 0.0)
    names = ("kr", "kl", "forward_slip_m", "forward_slip_length_m")
    found = {
        f"slip.{name}": Interval(float(v), float(a), float(b))
        for name, v, a, b in zip(names, values, low, high, strict=True)
    }
    return Slip(*map(float, values)), found


def lasting_blocks(alike: float) -> float:
    """Length, in blocks, of an Ornstein-Uhlenbeck process from its integrals over blocks.

    Integrals over a block and the next correlate by (1 - e)^2 / (2 (a - 1 + e)), with e = exp(-a)
    and the length 1 / a blocks. At most `_MOST_LASTING` blocks.
    """

    def off(a: float) -> float:
        e = math.exp(-a)
        return (1.0 - e) ** 2 / (2.0 * (a - 1.0 + e)) - alike

    least, most = 1.0 / _MOST_LASTING, 1e3
    if off(most) >= 0.0:
        return 0.0
    return 1.0 / float(optimize.brentq(off, least, most)) if off(least) > 0.0 else _MOST_LASTING


def _camera(
    recording: Recording, name: str, camera: StereoCamera, reference: Reference
) -> tuple[SensorBelief, dict[str, Interval], list[Array]]:
    """Scale, mount, delay and noise of a camera among known landmarks; only from a truth."""
    if reference.source is not Source.TRUTH or recording.world is None:
        return SensorBelief(), {}, [np.zeros(0)] * 4
    log, landmarks = recording.log(name), recording.world.landmarks
    inside = (log.stamps > reference.stamps[0] + LARGEST_DELAY_S) & (
        log.stamps < reference.stamps[-1] - LARGEST_DELAY_S
    )
    per_row = np.repeat(np.arange(len(log.stamps)), np.diff(log.known_splits))
    used = inside[per_row] & (log["ids"] >= 0) & (log["ids"] < len(landmarks))
    stamps, points = log.stamps[per_row][used], log["points_in_camera"][used]
    placed = landmarks[log["ids"][used], :2]
    require(
        len(stamps) >= 30, f"only {len(stamps)} sightings of known landmarks; give more of the log"
    )
    bearing = np.arctan2(-points[:, 0], points[:, 2])
    depth = points[:, 2]

    def ahead(delay_s: float) -> Array:
        """Landmarks (K, 2) in base_link, when the camera is this late."""
        poses = recording.truth_at(stamps + delay_s)
        turned = np.column_stack([placed, np.zeros(len(placed))])
        inverse: Array = se2.compose(se2.inverse(poses), turned)
        return inverse[:, :2]

    def off(delay_s: float) -> float:
        x, y = ahead(delay_s).T
        error = se2.wrap(bearing - np.arctan2(y, x))
        return float(np.nanmedian(np.abs(error - np.nanmedian(error))))

    delays = 0.02 * np.arange(-25, 26)  # 0 is one of them
    delay_s = float(delays[int(np.argmin([off(d) for d in delays]))])
    seen = ahead(delay_s)
    finite = np.isfinite(seen).all(axis=1)
    near = finite & (np.abs(se2.wrap(bearing - np.arctan2(seen[:, 1], seen[:, 0]))) < 0.5)

    def errors(unknowns: Array) -> Array:
        scale, x, y, yaw = unknowns
        cos, sin = math.cos(yaw), math.sin(yaw)
        u, v = seen[:, 0] - x, seen[:, 1] - y
        z, left = cos * u + sin * v, cos * v - sin * u
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.stack([depth / (scale * z) - 1.0, se2.wrap(bearing - np.arctan2(left, z))])

    start = np.array([np.median(depth[near] / seen[near, 0]), 0.0, 0.0, 0.0])
    spread = np.array([0.02, 0.02])
    for _ in range(3):

        def weighted(unknowns: Array) -> Array:
            flat: Array = (errors(unknowns)[:, near] / spread[:, None]).ravel()  # noqa: B023
            return flat

        fit = optimize.least_squares(weighted, start, loss="soft_l1", x_scale=[0.01] * 4)
        found = errors(fit.x)
        spread = MAD * np.median(np.abs(found[:, near]), axis=1) + 1e-6
        near = finite & np.all(np.abs(found) < _OUTLIER * spread[:, None], axis=0)
        start = fit.x
    # neighbouring sightings err together: twenty count as one
    covariance = np.linalg.inv(fit.jac.T @ fit.jac) * np.mean(fit.fun**2) * 20.0
    half = 1.96 * np.sqrt(np.diag(covariance))
    sigma_px = camera.focal_px * spread[1]
    # of the depth's error, which grows with the depth here, the disparity that explains its median
    by_square = MAD * np.median(np.abs(found[0, near] / depth[near]))
    disparity_px = camera.focal_px * camera.baseline_m * by_square
    scale, x, y, yaw = map(float, fit.x)
    belief = SensorBelief(x, y, yaw, scale, delay_s, None, float(sigma_px), float(disparity_px))
    n_out = int(np.sum(finite & ~near))
    names = ("scale", "x_m", "y_m", "yaw_rad")
    intervals = {
        f"sensors.{name}.{key}": Interval(float(v), float(v - h), float(v + h))
        for key, v, h in zip(names, fit.x, half, strict=True)
    }
    intervals[f"sensors.{name}.delay_s"] = Interval(delay_s, delay_s - 0.02, delay_s + 0.02)
    for label, value, errors_near in zip(
        ("depth error, share", "bearing error, rad"), spread, found[:, near], strict=True
    ):
        parts = [MAD * np.median(np.abs(part)) for part in np.array_split(errors_near, _N_PARTS)]
        known = mean_interval(parts)
        intervals[f"{name}: {label}"] = Interval(float(value), known.low, known.high)
    intervals[f"{name}: outliers"] = share_interval(n_out, int(finite.sum()))
    left = [depth[near], found[0, near] * depth[near], bearing[near], found[1, near]]
    return belief, intervals, left


def _laser_noise(
    recording: Recording, name: str, reference: Reference
) -> tuple[Interval, Interval, list[Array]]:
    """Noise of ranges by scans laid over one another, and the share of beams that do not fit.

    A beam of one scan, moved into the scan before, is compared with the line between the two beams
    on either side of it, where these are near to each other.
    """
    laser = recording.sensor(name, Laser)
    ranges = recording.log(name)["ranges_m"]
    rows = np.searchsorted(recording.log(name).stamps, reference.stamps)
    pairs = np.flatnonzero(reference.joined)[:: max(1, len(reference.joined) // 300)]
    mount, bearings = laser.mount.pose, laser.bearings_rad
    step = float(bearings[1] - bearings[0]) if len(bearings) > 1 else 1.0
    errors, distances = [], []
    for i in pairs:
        before, after = (ranges[rows[k]].astype(float) for k in (i, i + 1))
        motion = se2.between(
            se2.compose(reference.poses[i], mount), se2.compose(reference.poses[i + 1], mount)
        )
        seen_again = np.isfinite(after)
        directions = np.stack([np.cos(bearings), np.sin(bearings)], axis=1)[seen_again]
        ends = se2.transform(motion, after[seen_again, None] * directions)
        place = (np.arctan2(ends[:, 1], ends[:, 0]) - bearings[0]) / step
        inside = (place >= 0.0) & (place < len(bearings) - 1)
        ends, place = ends[inside], place[inside]
        k = place.astype(int)
        with np.errstate(invalid="ignore"):  # beams without a return are +inf
            smooth = np.abs(before[k + 1] - before[k]) < 0.05 * before[k]
            expected = before[k] + (place - k) * (before[k + 1] - before[k])
            off = np.hypot(*ends.T) - expected
        errors.append(off[smooth])
        distances.append(expected[smooth])
    error, distance = np.concatenate(errors), np.concatenate(distances)
    finite = np.isfinite(error)
    error, distance = error[finite], distance[finite]
    require(len(error) >= 100, "too few beams of neighbouring scans meet to tell their noise")
    spread = MAD * float(np.median(np.abs(error)))
    fits = np.abs(error) < _OUTLIER * spread
    # a beam, and the mean of two about half of the time
    per_beam = math.sqrt(1.0 + 2.0 / 3.0)
    parts = [MAD * np.median(np.abs(e)) / per_beam for e in np.array_split(error, _N_PARTS)]
    known = mean_interval(parts)
    noise = Interval(spread / per_beam, known.low, known.high)
    empty = np.zeros(0)
    return (
        noise,
        share_interval(int(np.sum(~fits)), len(fits)),
        [distance[fits], error[fits], empty, empty],
    )
