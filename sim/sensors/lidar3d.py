"""A spinning 3D lidar."""

import math
from typing import Any, ClassVar

import numpy as np

import sim.sensors.point_cloud as point_cloud
from sim.arrays import Array, ArrayLike, Floats
from sim.errors import require
from sim.options import NonNegative, Positive, options
from sim.sensors.base import Field, Mount, Probe, Reading, Schema
from sim.sensors.laser import Beams, check_range, noisy_ranges

_GROUND_M = 0.3  # points below are not drawn


@options("sensors.lidar3d")
class Lidar3D:
    """A spinning lidar: `n_rings` elevations by `n_azimuths` bearings, taken at one instant."""

    ros_message: ClassVar = point_cloud.MESSAGE
    ros_topic: ClassVar = "/points"

    rate_hz: Positive = 1.0
    """Turns per second."""
    n_rings: Beams = 16
    n_azimuths: Beams = 720
    elevation_min_rad: float = math.radians(-15.0)
    elevation_max_rad: float = math.radians(15.0)
    min_range_m: NonNegative = 0.4
    max_range_m: Positive = 100.0
    sigma_range_m: NonNegative = 0.03
    """Standard deviation of the Gaussian range noise."""
    mount: Mount = Mount(z_m=1.5)

    def __post_init__(self) -> None:
        check_range(self)
        low, high = self.elevation_min_rad, self.elevation_max_rad
        require(
            -math.pi / 2 < low <= high < math.pi / 2,
            "sensors.lidar3d.elevation_min_rad and elevation_max_rad must be in order and "
            f"inside (-pi/2, pi/2), got {low} and {high}",
        )

    @property
    def elevations_rad(self) -> Array:
        """Ring elevations (n_rings,), lowest first."""
        return np.linspace(self.elevation_min_rad, self.elevation_max_rad, self.n_rings)

    @property
    def azimuths_rad(self) -> Array:
        """Bearings (n_azimuths,), counter-clockwise from -pi."""
        return np.linspace(-math.pi, math.pi, self.n_azimuths, endpoint=False)

    @property
    def schema(self) -> Schema:
        """Ranges (n_rings, n_azimuths), +inf where nothing was seen."""
        return {"ranges_m": Field("m", "f4", (self.n_rings, self.n_azimuths))}

    def start(self, rng: np.random.Generator) -> Probe:
        """Probe that casts a turn and adds the noise."""
        return lambda view: {"ranges_m": self.measure(view.cloud(self), rng)}

    def measure(self, true_ranges_m: ArrayLike, rng: np.random.Generator) -> Floats:
        """Noisy ranges (n_rings, n_azimuths), float32; +inf where nothing is in range."""
        return noisy_ranges(self, true_ranges_m, rng)

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

    def points_in_base(self, reading: Reading) -> Array:
        """Points (N, 3), m, above the ground."""
        points = self.mount.points_in_base(self.points_in_sensor(reading["ranges_m"]))
        return points[points[:, 2] > _GROUND_M]

    def to_ros(self, reading: Reading) -> dict[str, Any]:
        """Fields of a PointCloud2, rings by azimuths; NaN where nothing was seen."""
        turn = reading["ranges_m"]
        seen = np.where(np.isfinite(turn), turn, np.nan).ravel()
        unit = self.points_in_sensor(np.ones(turn.shape))
        columns = {c: unit[:, i] * seen for i, c in enumerate("xyz")}
        return point_cloud.fields({**columns, "range": turn.ravel()}, height=len(turn))

    def from_ros(self, message: Any) -> Reading:
        """Reading of such a PointCloud2."""
        ranges = point_cloud.columns(message)["range"].astype(np.float32)
        return {"ranges_m": ranges.reshape(message.height, -1)}
