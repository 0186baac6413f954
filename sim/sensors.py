"""The sensors: what they are, where they sit, and the noise they have.

Casting rays is the business of `sim.casting` and `sim.bullet`; here are the geometry and the
noise laws. Ranges that see nothing are +inf, as REP-117 asks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim.arrays import Array
from sim.errors import InputError, required
from sim.settings import build, check_numbers


@dataclass(frozen=True)
class Mount:
    """Pose of a sensor in base_link: x forward, y left, z up (m), yaw (rad)."""

    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 0.2
    yaw_rad: float = 0.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not math.isfinite(value):
                raise InputError(f"sensors.mount.{name} must be a finite number, got {value}")

    @property
    def pose(self) -> Array:
        """T_base_sensor in the plane, (3,) m, m, rad."""
        return np.array([self.x_m, self.y_m, self.yaw_rad])


@dataclass(frozen=True)
class Encoder:
    """Wheel encoders; read at every Frame, and at `rate_hz` on their own if it is not None."""

    rate_hz: float | None = 20.0

    def __post_init__(self) -> None:
        if self.rate_hz is not None:
            check_numbers("sensors.encoder", self, ("rate_hz",))


@dataclass(frozen=True)
class Laser:
    """A planar laser scanner; beams run counter-clockwise from -fov/2 to +fov/2.

    Parameters
    ----------
    rate_hz
        Scans per second; a scan is taken at one instant.
    n_beams, fov_rad
        Beams and the angle between the first and the last one.
    min_range_m, max_range_m
        Returns outside are +inf.
    sigma_range_m
        Standard deviation of the Gaussian range noise.
    mount
        Where it sits on the robot.
    """

    rate_hz: float = 10.0
    n_beams: int = 721
    fov_rad: float = math.pi
    min_range_m: float = 0.02
    max_range_m: float = 80.0
    sigma_range_m: float = 0.01
    mount: Mount = field(default_factory=Mount)

    def __post_init__(self) -> None:
        check_numbers(
            "sensors.laser", self, ("rate_hz", "max_range_m"), ("min_range_m", "sigma_range_m")
        )
        if self.n_beams < 1:
            raise InputError(f"sensors.laser.n_beams must be at least 1, got {self.n_beams}")
        if not 0.0 < self.fov_rad <= 2.0 * math.pi:
            raise InputError(f"sensors.laser.fov_rad must lie in (0, 2 pi], got {self.fov_rad}")

    @property
    def bearings_rad(self) -> Array:
        """Beam angles (n_beams,) in the sensor frame; a full circle does not repeat its seam."""
        if self.n_beams == 1:
            return np.zeros(1)
        full = self.fov_rad > 2.0 * math.pi - 1e-9
        return np.linspace(-self.fov_rad / 2, self.fov_rad / 2, self.n_beams, endpoint=not full)

    def measure(self, true_ranges_m: ArrayLike, rng: np.random.Generator) -> NDArray[np.float32]:
        """Noisy ranges (..., n_beams), float32; +inf where nothing is in range."""
        return _measured(self, true_ranges_m, rng)


Selection = Literal["nearest", "random", "spread"]


@dataclass(frozen=True)
class StereoCamera:
    """A rectified stereo pair that observes point landmarks (gil2008, sec. IV-B).

    Observations are points in the camera frame (z forward, x right, y down), m, made from a
    noisy column, row and disparity by gil2008, eq. (9).

    Parameters
    ----------
    rate_hz
        Images per second.
    focal_px, baseline_m
        Focal length and distance between the cameras.
    fov_horizontal_rad, fov_vertical_rad
        Field of view.
    max_distance_m
        dmax: landmarks farther away are not observed.
    max_observations
        B: most observations of one image; 0 for all that are visible.
    selection
        Which B: the nearest, random ones, or the ones spread best over the image.
    sigma_column_px, sigma_row_px, sigma_disparity_px
        Noise of the detector (presets `paper`: 10, 10, 0.5; `pixel`: 1, 1, 0.5).
    correlated
        Noise the image coordinates, so that X, Y and Z share the disparity's error (the truth of
        a stereo pair). False draws X, Y, Z apart with the variances of eqs. (10)-(12), which is
        the diagonal R of the paper.
    identifies
        Whether observations come with the landmark's id (known data association).
    sigma_descriptor, sigma_view_descriptor
        Noise of each descriptor component: white, and growing with the change of viewing angle
        (per radian from the direction of its first appearance in the world frame).
    mount
        Pose of the left camera; its optical axis is the robot's x axis turned by the yaw.
    """

    rate_hz: float = 5.0
    focal_px: float = 381.0
    baseline_m: float = 0.12
    fov_horizontal_rad: float = math.radians(80.0)
    fov_vertical_rad: float = math.radians(60.0)
    max_distance_m: float = 10.0
    max_observations: int = 0
    selection: Selection = "random"
    sigma_column_px: float = 1.0
    sigma_row_px: float = 1.0
    sigma_disparity_px: float = 0.5
    correlated: bool = True
    identifies: bool = True
    sigma_descriptor: float = 0.05
    sigma_view_descriptor: float = 0.05
    mount: Mount = field(default_factory=lambda: Mount(z_m=0.5))

    def __post_init__(self) -> None:
        check_numbers(
            "sensors.stereo",
            self,
            ("rate_hz", "focal_px", "baseline_m", "max_distance_m"),
            (
                "sigma_column_px",
                "sigma_row_px",
                "sigma_disparity_px",
                "sigma_descriptor",
                "sigma_view_descriptor",
            ),
        )
        for name in ("fov_horizontal_rad", "fov_vertical_rad"):
            if not 0.0 < getattr(self, name) < math.pi:
                value = getattr(self, name)
                raise InputError(f"sensors.stereo.{name} must lie in (0, pi), got {value}")
        if self.max_observations < 0:
            raise InputError(
                "sensors.stereo.max_observations must be 0 (all) or more, "
                f"got {self.max_observations}"
            )
        if self.selection not in ("nearest", "random", "spread"):
            raise InputError(
                "sensors.stereo.selection must be nearest, random or spread, "
                f"got {self.selection!r}"
            )

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


@dataclass(frozen=True)
class Lidar3D:
    """A spinning lidar: `n_rings` elevations by `n_azimuths` bearings, taken at one instant."""

    rate_hz: float = 1.0
    n_rings: int = 16
    n_azimuths: int = 720
    elevation_min_rad: float = math.radians(-15.0)
    elevation_max_rad: float = math.radians(15.0)
    min_range_m: float = 0.4
    max_range_m: float = 100.0
    sigma_range_m: float = 0.03
    mount: Mount = field(default_factory=lambda: Mount(z_m=1.5))

    def __post_init__(self) -> None:
        check_numbers(
            "sensors.lidar3d", self, ("rate_hz", "max_range_m"), ("min_range_m", "sigma_range_m")
        )
        for name in ("n_rings", "n_azimuths"):
            if getattr(self, name) < 1:
                raise InputError(
                    f"sensors.lidar3d.{name} must be at least 1, got {getattr(self, name)}"
                )
        low, high = self.elevation_min_rad, self.elevation_max_rad
        if not -math.pi / 2 < low <= high < math.pi / 2:
            raise InputError(
                "sensors.lidar3d.elevation_min_rad and elevation_max_rad must be in order and "
                f"inside (-pi/2, pi/2), got {low} and {high}"
            )

    @property
    def elevations_rad(self) -> Array:
        """Ring elevations (n_rings,), lowest first."""
        return np.linspace(self.elevation_min_rad, self.elevation_max_rad, self.n_rings)

    @property
    def azimuths_rad(self) -> Array:
        """Bearings (n_azimuths,), counter-clockwise from -pi."""
        return np.linspace(-math.pi, math.pi, self.n_azimuths, endpoint=False)

    def measure(self, true_ranges_m: ArrayLike, rng: np.random.Generator) -> NDArray[np.float32]:
        """Noisy ranges (n_rings, n_azimuths), float32; +inf where nothing is in range."""
        return _measured(self, true_ranges_m, rng)

    def points_in_sensor(self, ranges_m: ArrayLike) -> Array:
        """Cartesian points (N, 3), m, of the finite ranges (n_rings, n_azimuths)."""
        ranges = np.asarray(ranges_m, float)
        elevation, azimuth = self.elevations_rad[:, None], self.azimuths_rad[None, :]
        directions = np.stack(
            [
                np.cos(elevation) * np.cos(azimuth),
                np.cos(elevation) * np.sin(azimuth),
                np.sin(elevation) * np.ones_like(azimuth),
            ],
            axis=-1,
        )
        seen = np.isfinite(ranges)
        points: Array = directions[seen] * ranges[seen][:, None]
        return points


def _measured(
    sensor: Laser | Lidar3D, true_ranges_m: ArrayLike, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Ranges with Gaussian noise, float32; +inf outside the sensor's limits."""
    ranges = np.asarray(true_ranges_m, float)
    noisy = np.maximum(ranges + sensor.sigma_range_m * rng.standard_normal(ranges.shape), 0.0)
    seen = (ranges >= sensor.min_range_m) & (ranges <= sensor.max_range_m)
    return np.where(seen, noisy, np.inf).astype(np.float32)


@dataclass(frozen=True)
class SensorSuite:
    """The sensors of one robot; None where it has none of a kind."""

    encoder: Encoder = field(default_factory=Encoder)
    laser: Laser | None = None
    stereo: StereoCamera | None = None
    lidar3d: Lidar3D | None = None

    # Never None: an InputError says what is missing and how to get it.

    @property
    def known_laser(self) -> Laser:
        """The laser; InputError if there is none."""
        return required(self.laser, "no laser; choose sensors that have one: sensors=hokuyo")

    @property
    def known_stereo(self) -> StereoCamera:
        """The stereo camera; InputError if there is none."""
        return required(
            self.stereo, "no stereo camera; choose sensors that have one: sensors=stereo_pixel"
        )

    @property
    def known_lidar3d(self) -> Lidar3D:
        """The 3D lidar; InputError if there is none."""
        return required(self.lidar3d, "no 3D lidar; choose sensors that have one: sensors=lidar3d")


def suite_from_config(config: dict[str, Any]) -> SensorSuite:
    """Sensors from plain mappings, keys as in the classes above.

    Raises
    ------
    InputError
        For an unknown sensor or key, or a value that makes no sense.
    """
    kinds: dict[str, Any] = {
        "encoder": Encoder,
        "laser": Laser,
        "stereo": StereoCamera,
        "lidar3d": Lidar3D,
    }
    sensors: dict[str, Any] = {}
    for name, settings in config.items():
        if name not in kinds:
            raise InputError(f"unknown sensor sensors.{name}; known: {', '.join(kinds)}")
        if settings is None:
            continue
        if isinstance(settings, dict) and "mount" in settings:
            mount = build(Mount, settings["mount"], f"sensors.{name}.mount")
            settings = {**settings, "mount": mount}
        sensors[name] = build(kinds[name], settings, f"sensors.{name}")
    return SensorSuite(**sensors)
