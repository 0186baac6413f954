"""How the sensors of a log err: the noise of a laser's ranges, and a camera among landmarks."""

import math

import numpy as np
from scipy import optimize

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
    recording: Recording, name: str, camera: StereoCamera, reference: Reference
) -> tuple[SensorBelief, dict[str, Interval], list[Array]]:
    """Scale, mount, delay and noise of a camera among known landmarks; only from a truth."""
    if reference.source is not Source.TRUTH or recording.world is None:
        return SensorBelief(), {}, [np.zeros(0)] * 4
    stamps, ids, points = sightings(recording, name, recording.world)
    inside = (stamps > reference.stamps[0] + LARGEST_DELAY_S) & (
        stamps < reference.stamps[-1] - LARGEST_DELAY_S
    )
    stamps, points, placed = (
        stamps[inside],
        points[inside],
        recording.world.landmarks[ids[inside], :2],
    )
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
    belief = SensorBelief(
        x_m=x,
        y_m=y,
        yaw_rad=yaw,
        scale=scale,
        delay_s=delay_s,
        sigma_column_px=float(sigma_px),
        sigma_disparity_px=float(disparity_px),
    )
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
        parts = [MAD * np.median(np.abs(part)) for part in np.array_split(errors_near, N_PARTS)]
        known = mean_interval(parts)
        intervals[f"{name}: {label}"] = Interval(float(value), known.low, known.high)
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
    parts = [MAD * np.median(np.abs(e)) / per_beam for e in np.array_split(error, N_PARTS)]
    known = mean_interval(parts)
    noise = Interval(spread / per_beam, known.low, known.high)
    empty = np.zeros(0)
    return (
        noise,
        share_interval(int(np.sum(~fits)), len(fits)),
        [distance[fits], error[fits], empty, empty],
    )
