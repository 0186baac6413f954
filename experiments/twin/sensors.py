"""What a log's sensors show beside white noise: outliers, missing readings, errors that last."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import scipy
from numpy.typing import NDArray

from experiments.calibration.sensor_noise import sightings
from sim import se2
from sim.arrays import Array
from sim.errors import require
from sim.recording import Recording
from sim.sensors import Laser, RealCamera, RealLaser, StereoCamera
from sim.sensors.rays import ExactRays
from sim.sensors.stereo import points_in_camera
from sim.worlds.world import World

Mask = NDArray[np.bool_]

_MISREAD_RAD, _MISREAD_SHARE = 0.25, 0.25  # errors beyond belong to another landmark
_LAGS_S = np.array([0.25, 0.5, 1.0, 2.0, 4.0])  # at which errors of a landmark are compared
_MOST_SCANS = 300
_SHORT_SIGMAS, _SHORT_M = 6.0, 0.3  # a beam that ends so far before its wall hit something else


def real_camera(
    recording: Recording, name: str, stamps: Array, way: Array, world: World
) -> RealCamera:
    """A camera that sees and errs as the log's did along a way (T, 3) at stamps (T,) s.

    Raises
    ------
    InputError
        If it saw too few landmarks.
    """
    camera = recording.sensor(name, StereoCamera)
    times, ids, points = sightings(recording, name, world)
    used = (times >= stamps[0]) & (times <= stamps[-1])
    times, ids, points = times[used], ids[used], points[used]
    require(len(times) >= 30, f"only {len(times)} sightings of landmarks; give more of the log")
    poses = poses_at(stamps, way, times)
    true = np.array(
        [
            points_in_camera(camera, p, world.landmarks[i : i + 1])[0]
            for p, i in zip(poses, ids, strict=True)
        ]
    )
    depth_error = points[:, 2] / true[:, 2] - 1.0
    bearings = [np.arctan2(-p[:, 0], p[:, 2]) for p in (points, true)]
    bearing_error = se2.wrap(bearings[0] - bearings[1])
    right = (np.abs(depth_error) < _MISREAD_SHARE) & (np.abs(bearing_error) < _MISREAD_RAD)
    errors = np.stack([depth_error, bearing_error], axis=1)[right]
    errors -= np.median(errors, axis=0)
    sigmas = np.std(errors, axis=0)
    lasting_share, lasting_s = _lasting(times[right], ids[right], errors / sigmas)
    reach = np.linalg.norm(true[right], axis=1)
    fov = 2.0 * float(np.quantile(np.abs(bearings[1][right]), 0.99))
    images = np.diff(np.unique(times))
    found = dataclasses.replace(
        camera, fov_horizontal_rad=min(fov, 3.0), max_distance_m=float(np.quantile(reach, 0.99))
    )
    period_ticks = max(1, round(300.0 * float(np.quantile(images, 0.3))))
    near_m = float(np.quantile(reach, 0.005))
    share, lasts_s = _detections(
        found, near_m, period_ticks / 300.0, stamps, way, world, times, ids
    )
    settings = {f.name: getattr(found, f.name) for f in dataclasses.fields(StereoCamera)}
    return RealCamera(
        **settings | {"rate_hz": 300.0 / period_ticks},
        sigma_depth=float(sigmas[0]),
        sigma_bearing_rad=float(sigmas[1]),
        lasting_share=lasting_share,
        lasting_s=lasting_s,
        detection_share=share,
        detection_s=lasts_s,
        misread_share=float(np.mean(~right)),
        min_distance_m=near_m,
    )


def _lasting(times: Array, ids: Array, errors: Array) -> tuple[float, float]:
    """Share of the variance of errors (K, 2), in units of their spread, that lasts, and how long.

    The products of a landmark's errors at each lag are fitted by share exp(-lag / time).
    """
    sums, counts = np.zeros(len(_LAGS_S)), np.zeros(len(_LAGS_S))
    for landmark in np.unique(ids):
        rows = np.flatnonzero(ids == landmark)
        for k in range(1, min(60, len(rows))):
            lags = times[rows[k:]] - times[rows[:-k]]
            products = (errors[rows[k:]] * errors[rows[:-k]]).mean(axis=1)
            for i, lag in enumerate(_LAGS_S):
                near = np.abs(lags - lag) < 0.4 * lag
                sums[i] += products[near].sum()
                counts[i] += near.sum()
    known = counts >= 30
    if known.sum() < 2:
        return 0.0, 1.0
    alike = sums[known] / counts[known]

    def off(unknowns: Array) -> Array:
        return np.asarray(unknowns[0] * np.exp(-_LAGS_S[known] / unknowns[1]) - alike)

    fit = scipy.optimize.least_squares(off, [0.5, 2.0], bounds=([0.0, 0.2], [1.0, 60.0]))
    return float(fit.x[0]), float(fit.x[1])


def _detections(
    camera: StereoCamera,
    near_m: float,
    period_s: float,
    stamps: Array,
    way: Array,
    world: World,
    times: Array,
    ids: Array,
) -> tuple[float, float]:
    """Share of the landmarks in view that are seen in an image, and the mean time that this lasts.

    From one image to the next a landmark stays seen with the probability share + (1 - share)
    exp(-period / time).
    """
    # the log shows only images with landmarks; those without one are filled in by the period
    images = np.arange(stamps[0], stamps[-1], period_s)
    poses = poses_at(stamps, way, images)
    nearest = np.clip(np.searchsorted(images, times - period_s / 2.0), 0, len(images) - 1)
    seen = np.zeros((len(images), len(world.landmarks)), bool)
    seen[nearest, ids] = True
    inside = np.zeros_like(seen)
    for row, pose in enumerate(poses):
        points = points_in_camera(camera, pose, world.landmarks)
        inside[row] = (
            np.abs(np.arctan2(points[:, 0], points[:, 2])) < camera.fov_horizontal_rad / 2.0
        )
        distance = np.linalg.norm(points, axis=1)
        inside[row] &= (distance >= near_m) & (distance <= camera.max_distance_m)
    share = float(np.clip(seen[inside].mean(), 0.01, 1.0))
    both = inside[1:] & inside[:-1] & seen[:-1]
    again = float(seen[1:][both].mean()) if both.any() else share
    if share >= 1.0:
        return 1.0, period_s
    lasts = np.clip((again - share) / (1.0 - share), 0.0, 0.99)
    return share, float(-period_s / math.log(max(lasts, 1e-3)))


def real_laser(
    recording: Recording,
    name: str,
    stamps: Array,
    way: Array,
    world: World,
    scheduled: Array,
) -> RealLaser:
    """A laser whose beams fail as often as the log's along a way (T, 3) at stamps (T,) s.

    Parameters
    ----------
    world
        The walls that the beams should hit.
    scheduled
        When it scans, s from the start.
    """
    laser, log = recording.sensor(name, Laser), recording.log(name)
    inside = np.flatnonzero((log.stamps >= stamps[0]) & (log.stamps <= stamps[-1]))
    rows = inside[:: max(1, len(inside) // _MOST_SCANS)]
    rays = ExactRays(world)
    expected = np.array(
        [rays.scan(laser, pose) for pose in poses_at(stamps, way, log.stamps[rows])]
    )
    measured = log["ranges_m"][rows].astype(float)
    wall = np.isfinite(expected)
    returned = laser.returned(measured)
    margin_m = max(_SHORT_M, _SHORT_SIGMAS * laser.sigma_range_m)
    short = wall & returned & (measured < expected - margin_m)
    missing = wall & ~returned
    short_share, short_beams = _runs(short, wall)
    missing_share, missing_beams = _runs(missing, wall & ~short)
    settings = {f.name: getattr(laser, f.name) for f in dataclasses.fields(Laser)}
    return RealLaser(
        **settings | {"rate_hz": 10.0},
        short_share=short_share,
        short_beams=short_beams,
        missing_share=missing_share,
        missing_beams=missing_beams,
        stamps=tuple(round(float(s), 4) for s in scheduled),
    )


def _runs(failed: Mask, asked: Mask) -> tuple[float, float]:
    """Share of the beams asked (scans, beams) that failed, and over how many it is settled."""
    share = float(failed.sum() / max(int(asked.sum()), 1))
    pairs = asked[:, 1:] & failed[:, :-1]
    if share in (0.0, 1.0) or not pairs.any():
        return share, 1.0
    alike = (float(failed[:, 1:][pairs].mean()) - share) / (1.0 - share)
    return share, 1.0 / (1.0 - float(np.clip(alike, 0.0, 0.99)))


def poses_at(stamps: Array, way: Array, times: Array) -> Array:
    """Poses (N, 3) at times (N,) within a way, interpolated."""
    heading = np.unwrap(way[:, 2])
    x, y, angle = (np.interp(times, stamps, v) for v in (way[:, 0], way[:, 1], heading))
    return np.stack([x, y, se2.wrap(angle)], axis=1)
