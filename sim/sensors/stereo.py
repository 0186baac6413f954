"""A stereo camera that observes point landmarks (gil2008)."""

from __future__ import annotations

import math
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import NonNegativeInt

import sim.sensors.point_cloud as point_cloud
from sim.arrays import Array, ArrayLike, Bools, Floats, Ints, Values
from sim.options import Acute, NonNegative, Positive, options
from sim.sensors.base import Field, Mount, Reading, Schema, View
from sim.worlds.world import World


@options("sensors.stereo")
class LensOptions:
    """The lenses of a rectified stereo pair and the noise of its detector."""

    rate_hz: Positive = 5.0
    """Images per second."""
    focal_px: Positive = 381.0
    baseline_m: Positive = 0.12
    """Distance between the cameras."""
    fov_horizontal_rad: Acute = math.radians(80.0)
    fov_vertical_rad: Acute = math.radians(60.0)
    max_distance_m: Positive = 10.0
    """dmax: what is farther away is not observed."""
    sigma_column_px: NonNegative = 1.0
    """Noise of the detector (presets `paper`: 10, 10, 0.5; `pixel`: 1, 1, 0.5)."""
    sigma_row_px: NonNegative = 1.0
    sigma_disparity_px: NonNegative = 0.5
    identifies: bool = True
    """Whether observations come with the landmark's id, or the robot's number (known data
    association)."""
    mount: Mount = Mount(z_m=0.5)
    """Pose of the left camera; its optical axis is the robot's x axis turned by the yaw."""


@options("sensors.stereo")
class StereoCamera(LensOptions):
    """A rectified stereo pair that observes point landmarks (gil2008, sec. IV-B).

    Observations are points in the camera frame (z forward, x right, y down), m, made from a
    noisy column, row and disparity by gil2008, eq. (9).
    """

    ros_message: ClassVar = point_cloud.MESSAGE
    ros_topic: ClassVar = "/landmarks"
    ros_optical: ClassVar = True  # the frame of its messages: z forward, x right, y down

    max_observations: NonNegativeInt = 0
    """B: most observations of one image; 0 for all that are visible."""
    selection: Literal["nearest", "random", "spread"] = "random"
    """Which B: the nearest, random ones, or the ones spread best over the image."""
    correlated: bool = True
    """Noise the image coordinates, so that X, Y and Z share the disparity's error (the truth of a
    stereo pair). False draws X, Y, Z apart with the variances of eqs. (10)-(12), which is the
    diagonal R of the paper."""
    sigma_descriptor: NonNegative = 0.05
    """White noise of each descriptor component."""
    sigma_view_descriptor: NonNegative = 0.05
    """Noise of each component that grows with the change of viewing angle, per radian from the
    direction of the landmark's first appearance in the world frame."""

    @property
    def schema(self) -> Schema:
        """Points with descriptors, and ids if the camera identifies; true ids beside them."""
        ids = {"ids": Field("", "i8", ragged=True)} if self.identifies else {}
        return {
            "points_in_camera": Field("m", "f8", (3,), ragged=True),
            **ids,
            "descriptors": Field("", "f4", (None,), ragged=True),
            "true_ids": Field("", "i8", ragged=True, truth=True),
        }

    def start(self, rng: np.random.Generator) -> LandmarkEye:
        """Probe that looks for the world's landmarks."""
        return LandmarkEye(self, rng)

    def points_in_base(self, reading: Reading) -> Array:
        """Points (K, 3), m, of the landmarks seen."""
        x, y, z = reading["points_in_camera"].T
        return self.mount.points_in_base(np.column_stack([z, -x, -y]))

    def to_ros(self, reading: Reading) -> dict[str, Any]:
        """Fields of a PointCloud2: x, y, z in the optical frame, id, d0, d1, ..."""
        parts = {c: reading["points_in_camera"][:, i] for i, c in enumerate("xyz")}
        if "ids" in reading:
            parts["id"] = reading["ids"].astype(np.int32)
        parts |= {f"d{i}": column for i, column in enumerate(reading["descriptors"].T)}
        return point_cloud.fields(parts)

    def from_ros(self, message: Any) -> Reading:
        """Reading of such a PointCloud2; true ids where an old bag has them in it."""
        rows = point_cloud.columns(message)
        names = rows.dtype.names or ()
        wide = [rows[n] for n in names if n[0] == "d" and n[1:].isdigit()]
        ids = {"id": "ids", "true_id": "true_ids"}
        return {
            "points_in_camera": np.stack([rows[c] for c in "xyz"], axis=1).astype(np.float64),
            "descriptors": np.reshape(wide, (len(wide), len(rows))).T.astype(np.float32),
            **{ours: rows[name].astype(np.int64) for name, ours in ids.items() if name in names},
        }

    def covariance(self, points_in_camera: ArrayLike) -> Array:
        """Covariance R (..., 3, 3), m^2, of observations of points (..., 3) by eqs. (10)-(12).

        With `correlated`, the off-diagonal terms of the shared disparity error are kept; the
        paper's R is the diagonal.
        """
        x, y, z = np.moveaxis(np.asarray(points_in_camera, float), -1, 0)
        disparity = self.focal_px * self.baseline_m / z
        column, row = self.focal_px * x / z, self.focal_px * y / z
        scale = self.baseline_m / disparity
        slope = scale / disparity  # metres per pixel of disparity and of image coordinate
        by_disparity = np.stack([-slope * column, -slope * row, -slope * self.focal_px], axis=-1)
        if self.correlated:
            outer = by_disparity[..., :, None] * by_disparity[..., None, :]
            R: Array = outer * self.sigma_disparity_px**2
        else:
            R = np.zeros((*x.shape, 3, 3))
            for i in range(3):
                R[..., i, i] = (by_disparity[..., i] * self.sigma_disparity_px) ** 2
        R[..., 0, 0] += (scale * self.sigma_column_px) ** 2
        R[..., 1, 1] += (scale * self.sigma_row_px) ** 2
        return R

    def measure(self, points_in_camera: ArrayLike, rng: np.random.Generator) -> Array:
        """Noisy observations (N, 3), m, of points (N, 3) in the camera frame.

        A point whose noisy disparity is not positive cannot be triangulated: its row is NaN.
        """
        points = np.asarray(points_in_camera, float)
        draws = rng.standard_normal(points.shape)
        if not self.correlated:
            sigma = np.sqrt(np.diagonal(self.covariance(points), axis1=-2, axis2=-1))
            observed: Array = points + sigma * draws
            observed[observed[:, 2] <= 0.0] = np.nan
            return observed
        x, y, z = points.T
        column = self.focal_px * x / z + self.sigma_column_px * draws[:, 0]
        row = self.focal_px * y / z + self.sigma_row_px * draws[:, 1]
        disparity = self.focal_px * self.baseline_m / z + self.sigma_disparity_px * draws[:, 2]
        disparity = np.where(disparity > 0.0, disparity, np.nan)
        rays = np.stack([column, row, np.full_like(row, self.focal_px)], axis=-1)
        return rays * (self.baseline_m / disparity[:, None])


def points_in_camera(camera: StereoCamera, pose: Array, points_in_world: Array) -> Array:
    """Points (N, 3) of map in the camera frame (z forward, x right, y down), m."""
    planar = camera.mount.in_map(pose)
    offset = points_in_world - np.array([planar[0], planar[1], camera.mount.z_m])
    cos, sin = math.cos(planar[2]), math.sin(planar[2])
    forward = cos * offset[:, 0] + sin * offset[:, 1]
    left = -sin * offset[:, 0] + cos * offset[:, 1]
    return np.stack([-left, -offset[:, 2], forward], axis=-1)


def in_field_of_view(camera: StereoCamera, points: Array) -> Bools:
    """Which points (N, 3) of the camera frame are within its angles and its greatest distance."""
    x, y, z = points.T
    return np.asarray(
        (z > 0.05)
        & (np.abs(x) <= z * math.tan(camera.fov_horizontal_rad / 2))
        & (np.abs(y) <= z * math.tan(camera.fov_vertical_rad / 2))
        & (np.linalg.norm(points, axis=1) <= camera.max_distance_m)
    )


class LandmarkEye:
    """The stereo camera at work on the world's landmarks."""

    def __init__(self, camera: StereoCamera, rng: np.random.Generator) -> None:
        self._camera, self._rng = camera, rng

    def begin(self, view: View) -> None:
        """Draw how each landmark's descriptor changes with the direction it is seen from."""
        world, rng = view.world, self._rng
        size = world.descriptors.shape[1] if world.descriptors.ndim == 2 else 0
        self._view_axes = rng.standard_normal((len(world.landmarks), size)).astype(np.float32)
        if size:
            self._view_axes /= np.linalg.norm(self._view_axes, axis=1, keepdims=True)
        self._first_view_rad = np.full(len(world.landmarks), np.nan)

    def __call__(self, view: View) -> Reading:
        """Observe the landmarks in view."""
        camera, landmarks = self._camera, view.world.landmarks
        inside = points_in_camera(camera, view.pose, landmarks)
        origin = np.array([*camera.mount.in_map(view.pose)[:2], camera.mount.z_m])
        ids = np.flatnonzero(in_field_of_view(camera, inside))
        ids = ids[view.sees(origin, landmarks[ids])]
        ids = choose(camera, ids, inside, self._rng)
        observed = camera.measure(inside[ids], self._rng)
        descriptors = self._describe(view.world, ids, origin)
        whole = np.isfinite(observed).all(axis=1)
        reading: dict[str, Values] = {
            "points_in_camera": observed[whole],
            "descriptors": descriptors[whole],
            "true_ids": ids[whole].astype(np.int64),
        }
        return reading | ({"ids": reading["true_ids"]} if camera.identifies else {})

    def _describe(self, world: World, ids: Ints, origin: Array) -> Floats:
        """Noisy descriptors: white noise, and a drift with the change of the viewing angle."""
        camera = self._camera
        if world.descriptors.size == 0:
            return np.zeros((len(ids), 0), np.float32)
        offset = world.landmarks[ids, :2] - origin[:2]
        view = np.arctan2(offset[:, 1], offset[:, 0])
        fresh = np.isnan(self._first_view_rad[ids])
        self._first_view_rad[ids[fresh]] = view[fresh]
        change = np.abs((view - self._first_view_rad[ids] + np.pi) % (2 * np.pi) - np.pi)
        size = world.descriptors.shape[1]
        white = self._rng.standard_normal((len(ids), size)) / math.sqrt(size)
        noisy = (
            world.descriptors[ids]
            + camera.sigma_descriptor * white
            + camera.sigma_view_descriptor * change[:, None] * self._view_axes[ids]
        )
        unit: Floats = (noisy / np.linalg.norm(noisy, axis=1, keepdims=True)).astype(np.float32)
        return unit


def choose(camera: StereoCamera, ids: Ints, inside: Array, rng: np.random.Generator) -> Ints:
    """At most B of the visible landmarks, by the camera's rule."""
    most = camera.max_observations
    if most == 0 or len(ids) <= most:
        return ids
    if camera.selection == "nearest":
        order = np.argsort(np.linalg.norm(inside[ids], axis=1), kind="stable")
        return ids[order[:most]]
    if camera.selection == "random":
        return rng.choice(ids, most, replace=False)
    # Farthest-point choice over the image: each next landmark is the one farthest, in
    # pixels, from those already taken.
    pixels = inside[ids, :2] / inside[ids, 2:]
    taken = [int(np.argmin(np.linalg.norm(pixels, axis=1)))]
    gap = np.linalg.norm(pixels - pixels[taken[0]], axis=1)
    while len(taken) < most:
        taken.append(int(np.argmax(gap)))
        gap = np.minimum(gap, np.linalg.norm(pixels - pixels[taken[-1]], axis=1))
    return ids[taken]
