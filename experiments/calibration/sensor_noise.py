"""How the sensors of a log err: the noise of a laser's ranges, and a camera among landmarks."""

import math

import numpy as np
import scipy

from experiments.calibration.logs import Mask, fit_intervals
from experiments.calibration.reference import LARGEST_DELAY_S, N_PARTS, Reference, Source
from experiments.evaluation.statistics import Interval, mean_interval, share_interval
from experiments.runs.calibration import SensorBelief
from sim import se2
from sim.arrays import Array, Ints
from sim.errors import require
from sim.recording import Recording
from sim.sensors import Laser, StereoCamera
from sim.worlds.world import World

MAD = 1.4826  # standard deviation of a normal over its median absolute deviation
_OUTLIER = 6.0  # in robust standard deviations


def sightings(recording: Recording, name: str, world: World) -> tuple[Array, Ints, Array]:
    """Stamps (K,) s, ids (K,) and points (K, 3) in the camera of a world's landmarks as seen."""
    log = recording.log(name)
    stamps = np.repeat(log.stamps, np.diff(log.known_splits))
    known = (log["ids"] >= 0) & (log["ids"] < len(world.landmarks))
    return stamps[known], log["ids"][known], log["points_in_camera"][known]


def camera_noise(
    recording: Recording, name: str, reference: Reference
) -> tuple[SensorBelief, dict[str, Interval], list[Array]]:
    """Scale, mount, delay and noise of a camera among known landmarks; only from a truth."""
    if reference.source is not Source.TRUTH or recording.world is None:
        return SensorBelief(), {}, [np.zeros(0)] * 4
    camera = recording.sensor(name, StereoCamera)
    stamps, ids, points = sightings(recording, name, recording.world)
    inside = (stamps > reference.stamps[0] + LARGEST_DELAY_S) & (
        stamps < reference.stamps[-1] - LARGEST_DELAY_S
    )
    stamps, points = stamps[inside], points[inside]
    placed = np.pad(recording.world.landmarks[ids[inside], :2], ((0, 0), (0, 1)))
    require(
        len(stamps) >= 30, f"only {len(stamps)} sightings of known landmarks; give more of the log"
    )
    bearing, depth = np.arctan2(-points[:, 0], points[:, 2]), points[:, 2]

    def ahead(delay_s: float) -> Array:
        """Landmarks (K, 2) in base_link, when the camera is this late."""
        poses = recording.truth_at(stamps + delay_s)
        return np.asarray(se2.compose(se2.inverse(poses), placed)[:, :2])

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

    def weighted(unknowns: Array, near: Mask, spread: Array) -> Array:
        return np.asarray(errors(unknowns)[:, near] / spread[:, None]).ravel()

    start = np.array([np.median(depth[near] / seen[near, 0]), 0.0, 0.0, 0.0])
    spread = np.array([0.02, 0.02])
    for _ in range(3):
        fit = scipy.optimize.least_squares(
            weighted, start, loss="soft_l1", x_scale=[0.01] * 4, args=(near, spread)
        )
        found = errors(fit.x)
        spread = MAD * np.median(np.abs(found[:, near]), axis=1) + 1e-6
        near = finite & np.all(np.abs(found) < _OUTLIER * spread[:, None], axis=0)
        start = fit.x
    sigma_px = camera.focal_px * spread[1]
    # of the depth's error, which grows with the depth here, the disparity that explains its median
    by_square = MAD * np.median(np.abs(found[0, near] / depth[near]))
    disparity_px = camera.focal_px * camera.baseline_m * by_square
    scale, x, y, yaw = map(float, fit.x)
    belief = SensorBelief(
        x_m=x,
        y_m=y,
        yaw_rad=yaw,
        scale=scale,
        delay_s=delay_s,
        sigma_column_px=float(sigma_px),
        sigma_disparity_px=float(disparity_px),
    )
    # neighbouring sightings err together: twenty count as one
    bounds = fit_intervals(fit.x, fit, alike=20.0, z=1.96)
    keys = (f"sensors.{name}.{key}" for key in ("scale", "x_m", "y_m", "yaw_rad"))
    intervals = dict(zip(keys, bounds, strict=True))
    intervals[f"sensors.{name}.delay_s"] = Interval(delay_s, delay_s - 0.02, delay_s + 0.02)
    for label, value, errors_near in zip(
        ("depth error, share", "bearing error, rad"), spread, found[:, near], strict=True
    ):
        intervals[f"{name}: {label}"] = _by_parts(float(value), errors_near)
    n_out = int(np.sum(finite & ~near))
    intervals[f"{name}: outliers"] = share_interval(n_out, int(finite.sum()))
    left = [depth[near], found[0, near] * depth[near], bearing[near], found[1, near]]
    return belief, intervals, left


def laser_noise(
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
    directions = np.stack([np.cos(bearings), np.sin(bearings)], axis=1)
    step = float(bearings[1] - bearings[0]) if len(bearings) > 1 else 1.0
    errors, distances = [], []
    for i in pairs:
        before, after = (ranges[rows[k]].astype(float) for k in (i, i + 1))
        motion = se2.between(
            se2.compose(reference.poses[i], mount), se2.compose(reference.poses[i + 1], mount)
        )
        again = np.isfinite(after)
        ends = se2.transform(motion, after[again, None] * directions[again])
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
    require(len(error) >= 100, "too few beams of consecutive scans overlap to estimate noise")
    spread = MAD * float(np.median(np.abs(error)))
    fits = np.abs(error) < _OUTLIER * spread
    # a beam, and the mean of two about half of the time
    per_beam = math.sqrt(1.0 + 2.0 / 3.0)
    noise = _by_parts(spread / per_beam, error, per_beam)
    outliers = share_interval(int(np.sum(~fits)), len(fits))
    return noise, outliers, [distance[fits], error[fits], np.zeros(0), np.zeros(0)]


def _by_parts(value: float, errors: Array, unit: float = 1.0) -> Interval:
    """A robust deviation, in a unit, with the interval that parts of the errors (K,) show."""
    parts = [MAD * np.median(np.abs(part)) / unit for part in np.array_split(errors, N_PARTS)]
    spread = mean_interval(parts)
    return Interval(value, spread.low, spread.high)
