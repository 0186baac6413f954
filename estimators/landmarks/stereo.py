"""The stereo camera as a filter sees it: a landmark's point, and the covariance of its noise.

A landmark l lies at p = C(s) (l - t(s)) in the camera frame (x right, y down, z forward), where
C turns map axes into camera axes and t is the camera's position at robot pose s. The measurement
z = (X, Y, Z) is that point with noise (gil2008, eq. (9)), so dz/dl = C is orthonormal, and an
update may be computed in map axes: with G = 1, v = t + C^T z - l and C^T R C for R.

R at a point p of depth z follows from eqs. (10)-(12). With the correlations that a shared disparity
error makes it is

    R = (z / f)^2 diag(sigma_c^2, sigma_r^2, 0) + (z / (f B))^2 sigma_d^2 p p^T,

and the paper's diagonal R is the diagonal of this. R belongs to the predicted point: taken from the
noisy measurement, whose disparity enters by d^-4, near errors weigh more than far ones and pull
landmarks toward the camera.

Measuring in image coordinates (c, r, d) instead, where the noise is Gaussian and the same
everywhere, needs no other filter: linearised at the prediction, D^-1 (h - h_hat) with D = dh/dp is

    v_image = (z_predicted / Z) v,

the innovation in metres shortened or stretched by one factor, and R is the correlated one. The
density of h, as a density of z, has the determinant of S multiplied by (Z / z_predicted)^8.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim.arrays import Array
from sim.options import options
from sim.sensors import StereoCamera

NoiseModel = Literal["camera", "diagonal", "correlated", "image"]
NoiseAt = Literal["predicted", "measured"]

MIN_DEPTH_M = 0.1  # nearer than this no camera sees, and noise laws end


@options("estimator")
class StereoOptions:
    """Which camera a method reads."""

    stereo: str = "stereo"
    """Name of the stereo camera."""


@options("estimator")
class TeamEyesOptions(StereoOptions):
    """Which cameras a method for teams reads."""

    robots: str | None = None
    """Name of the sensor that sees the other robots of a team, with ids (`ekf_slam` does without);
    null: sightings are not used."""


class PackedCamera(NamedTuple):
    """A `StereoModel` as plain numbers.

    Attributes
    ----------
    per_focal, per_disparity
        1 / f and 1 / (f B), 1/px and 1/(px m).
    column_variance, row_variance, disparity_variance
        px^2.
    height_m
        Of the camera.
    correlated, in_image, at_measured
        As in `StereoModel`.
    unit_determinant
        Of the correlated R at a depth of 1 m; it grows as depth^8.
    """

    per_focal: float
    per_disparity: float
    column_variance: float
    row_variance: float
    disparity_variance: float
    height_m: float
    correlated: bool
    in_image: bool
    at_measured: bool
    unit_determinant: float


@dataclass(frozen=True)
class StereoModel:
    """What a filter believes of the camera.

    Attributes
    ----------
    focal_px, baseline_m
        Focal length and baseline.
    mount
        (3,) m, m, rad: pose of the camera in base_link, in the plane.
    height_m
        Height of the camera over the ground.
    variances_px2
        (3,) of column, row and disparity.
    correlated, in_image
        Whether R keeps its correlations, and whether innovations are those of the image.
    at_measured
        R at the measured point and not at the predicted one.
    """

    focal_px: float
    baseline_m: float
    mount: Array
    height_m: float
    variances_px2: Array
    correlated: bool
    in_image: bool
    at_measured: bool = False

    @classmethod
    def of(
        cls,
        camera: StereoCamera,
        noise_model: NoiseModel = "camera",
        noise_at: NoiseAt = "predicted",
    ) -> StereoModel:
        """Believe the camera's own figures.

        The noise is as `estimators.landmarks.slam_frontend.LandmarkSlamOptions` describes it.
        """
        if noise_model == "camera":
            noise_model = "image" if camera.correlated else "diagonal"
        sigma = (camera.sigma_column_px, camera.sigma_row_px, camera.sigma_disparity_px)
        return cls(
            camera.focal_px,
            camera.baseline_m,
            camera.mount.pose,
            camera.mount.z_m,
            np.maximum(np.square(np.array(sigma, float)), 1e-6),  # a perfect camera still rounds
            noise_model != "diagonal",
            noise_model == "image",
            noise_at == "measured",
        )

    @property
    def packed(self) -> PackedCamera:
        """For the compiled loops."""
        by_focal, by_disparity = 1.0 / self.focal_px, 1.0 / (self.focal_px * self.baseline_m)
        column, row, disparity = self.variances_px2.tolist()
        return PackedCamera(
            by_focal,
            by_disparity,
            column,
            row,
            disparity,
            self.height_m,
            self.correlated,
            self.in_image,
            self.at_measured,
            column * row * disparity * by_focal**4 * by_disparity**2,
        )

    def usable(self, points_in_camera: ArrayLike) -> NDArray[np.bool_]:
        """Which measurements (K, 3) can be used.

        Those that are finite and off the lens, with a disparity above its own standard deviation.
        """
        points = np.asarray(points_in_camera, dtype=np.float64)
        farthest = self.focal_px * self.baseline_m / math.sqrt(self.variances_px2[2])
        depth, finite = points[..., 2], np.isfinite(points).all(axis=-1)
        return finite & (depth > MIN_DEPTH_M / 2.0) & (depth < farthest)

    def axes(self, pose: ArrayLike) -> tuple[Array, Array]:
        """Camera position (..., 3) in map, and C (..., 3, 3) from map to camera axes."""
        pose = np.asarray(pose, dtype=np.float64)
        cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
        x, y, yaw = self.mount
        position = np.stack(
            [
                pose[..., 0] + cos * x - sin * y,
                pose[..., 1] + sin * x + cos * y,
                np.full_like(cos, self.height_m),
            ],
            axis=-1,
        )
        cos, sin = np.cos(pose[..., 2] + yaw), np.sin(pose[..., 2] + yaw)
        C = np.zeros((*cos.shape, 3, 3))
        C[..., 0, 0], C[..., 0, 1] = sin, -cos
        C[..., 1, 2] = -1.0
        C[..., 2, 0], C[..., 2, 1] = cos, sin
        return position, C

    def predict(self, pose: ArrayLike, landmarks: ArrayLike) -> tuple[Array, Array, Array]:
        """Predicted measurements of landmarks (..., 3) from a pose (..., 3), with derivatives.

        Returns
        -------
        tuple
            Points (..., 3) in the camera frame, m; their derivative (..., 3, 3) by the pose and
            (..., 3, 3) by the landmark.
        """
        pose, landmarks = np.asarray(pose, float), np.asarray(landmarks, float)
        position, C = self.axes(pose)
        points = np.einsum("...ij,...j->...i", C, landmarks - position)
        arm = landmarks[..., :2] - pose[..., :2]
        in_map = np.zeros((*points.shape, 3))
        in_map[..., 0, 0] = in_map[..., 1, 1] = -1.0
        in_map[..., 0, 2], in_map[..., 1, 2] = arm[..., 1], -arm[..., 0]
        return points, C @ in_map, np.broadcast_to(C, in_map.shape)

    def place(self, pose: ArrayLike, points_in_camera: ArrayLike) -> Array:
        """Landmarks (..., 3) in map of measured points: g^-1 of gil2008, eq. (17)."""
        position, C = self.axes(pose)
        points = np.asarray(points_in_camera, dtype=np.float64)
        return np.asarray(position + np.einsum("...ji,...j->...i", C, points))

    def covariance(self, points_in_camera: ArrayLike) -> Array:
        """R (..., 3, 3), m^2, at points (..., 3) in the camera frame."""
        points = np.asarray(points_in_camera, dtype=np.float64)
        depth = np.maximum(points[..., 2], MIN_DEPTH_M)
        ray = np.concatenate([points[..., :2], depth[..., None]], axis=-1)
        scale = (depth / (self.focal_px * self.baseline_m)) ** 2 * self.variances_px2[2]
        R: Array = scale[..., None, None] * ray[..., :, None] * ray[..., None, :]
        if not self.correlated:
            R *= np.eye(3)
        for i in (0, 1):
            R[..., i, i] += (depth / self.focal_px) ** 2 * self.variances_px2[i]
        return R

    def innovation(self, predicted: ArrayLike, measured: ArrayLike) -> tuple[Array, Array]:
        """Innovation v (..., 3), m, of measured points and the R (..., 3, 3) that goes with it."""
        expected = np.asarray(predicted, dtype=np.float64)
        seen = np.asarray(measured, dtype=np.float64)
        v, at = seen - expected, seen if self.at_measured else expected
        if self.in_image:
            v = v * (np.maximum(at[..., 2], MIN_DEPTH_M) / seen[..., 2])[..., None]
        return v, self.covariance(at)

    def to_image(self, points_in_camera: ArrayLike) -> Array:
        """Column and row from the principal point, and disparity, (..., 3) px, by eq. (9)."""
        x, y, z = np.moveaxis(np.asarray(points_in_camera, dtype=np.float64), -1, 0)
        pixels = [self.focal_px * x / z, self.focal_px * y / z, self.focal_px * self.baseline_m / z]
        return np.stack(pixels, axis=-1)
