"""A planar laser scanner. Ranges that see nothing are +inf, as REP-117 asks."""

import math
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field as Bound

from sim.arrays import Array, ArrayLike, Bools, Floats
from sim.errors import require
from sim.options import NonNegative, Positive, options
from sim.sensors.base import Field, Mount, Probe, Reading, Schema

Beams = Annotated[int, Bound(ge=1, le=1_000_000)]  # of one scan: no memory holds more


@options("sensors.laser")
class Laser:
    """A planar laser scanner; beams run counter-clockwise from -fov/2 to +fov/2."""

    ros_message: ClassVar = "sensor_msgs/msg/LaserScan"
    ros_topic: ClassVar = "/scan"

    rate_hz: Positive = 10.0
    """Scans per second."""
    n_beams: Beams = 721
    fov_rad: Annotated[float, Bound(gt=0.0, le=2.0 * math.pi)] = math.pi
    """Angle between the first and the last beam."""
    min_range_m: NonNegative = 0.02
    """Returns below are +inf."""
    max_range_m: Positive = 80.0
    """Returns beyond are +inf."""
    sigma_range_m: NonNegative = 0.01
    """Standard deviation of the Gaussian range noise."""
    sweep_s: NonNegative = 0.0
    """Time from the first beam of a pass to its last, s; 0: a scan is taken at one instant. The
    stamp is that of the last beam."""
    interlaced: Annotated[int, Bound(ge=1, le=100)] = 1
    """Passes of the mirror over which the beams of a sweep are spread, evenly over a scan: of n,
    each measures every n-th beam (SICK's quarter degree takes four, of a degree each)."""
    mount: Mount = Mount()
    """Where it sits on the robot."""

    def __post_init__(self) -> None:
        check_range(self)

    @property
    def bearings_rad(self) -> Array:
        """Beam angles (n_beams,) in the sensor frame; a full circle does not repeat its seam."""
        if self.n_beams == 1:
            return np.zeros(1)
        full = self.fov_rad > 2.0 * math.pi - 1e-9
        return np.linspace(-self.fov_rad / 2, self.fov_rad / 2, self.n_beams, endpoint=not full)

    @property
    def beam_offsets_s(self) -> Array:
        """When each beam (n_beams,) is measured, s after the scan's stamp: zero or negative."""
        beam = np.arange(self.n_beams)
        if self.sweep_s == 0.0:
            return np.zeros(self.n_beams)
        times = self.sweep_s * beam / max(self.n_beams - 1, 1)
        times += beam % self.interlaced / (self.interlaced * self.rate_hz)
        return np.asarray(times - times.max())

    @property
    def schema(self) -> Schema:
        """Ranges (n_beams,), +inf where nothing was seen."""
        return {"ranges_m": Field("m", "f4", (self.n_beams,))}

    def start(self, rng: np.random.Generator) -> Probe:
        """Probe that casts the beams and adds the noise."""
        return lambda view: {"ranges_m": self.measure(view.scan(self), rng)}

    def measure(self, true_ranges_m: ArrayLike, rng: np.random.Generator) -> Floats:
        """Noisy ranges (..., n_beams), float32; +inf where nothing is in range."""
        return noisy_ranges(self, true_ranges_m, rng)

    def returned(self, ranges_m: ArrayLike) -> Bools:
        """Whether each beam saw something: ranges at the limits or beyond, and NaN, are none.

        A range of 32 bits at the maximum may be read as just below it.
        """
        ranges = np.asarray(ranges_m, float)
        most_m = min(self.max_range_m, float(np.float32(self.max_range_m)))
        return (ranges > self.min_range_m) & (ranges < most_m)

    def points_in_base(self, reading: Reading) -> Array:
        """Points (N, 2), m, of the beams that saw something."""
        ranges = np.asarray(reading["ranges_m"], float)
        seen = np.isfinite(ranges)
        bearings = self.bearings_rad[seen]
        points = ranges[seen, None] * np.column_stack([np.cos(bearings), np.sin(bearings)])
        return self.mount.points_in_base(points)

    def to_ros(self, reading: Reading) -> dict[str, Any]:
        """Fields of a LaserScan."""
        bearings = self.bearings_rad
        return {
            "angle_min": float(bearings[0]),
            "angle_max": float(bearings[-1]),
            "angle_increment": float(bearings[1] - bearings[0]) if len(bearings) > 1 else 0.0,
            "scan_time": 1.0 / self.rate_hz,
            "range_min": self.min_range_m,
            "range_max": self.max_range_m,
            "ranges": reading["ranges_m"],
        }

    def from_ros(self, message: Any) -> Reading:
        """Reading of a LaserScan."""
        return {"ranges_m": np.asarray(message.ranges, np.float32)}


def check_range(sensor: Any) -> None:
    """Check that a sensor's ranges begin before they end, or it would see nothing."""
    require(
        sensor.min_range_m < sensor.max_range_m,
        f"{sensor._options_place}.min_range_m must be below max_range_m, or nothing is seen; got "
        f"{sensor.min_range_m:g} and {sensor.max_range_m:g}",
    )


def noisy_ranges(sensor: Any, true_ranges_m: ArrayLike, rng: np.random.Generator) -> Floats:
    """Ranges with Gaussian noise, float32; +inf outside the sensor's limits."""
    ranges = np.asarray(true_ranges_m, float)
    noisy = np.maximum(ranges + sensor.sigma_range_m * rng.standard_normal(ranges.shape), 0.0)
    seen = (ranges >= sensor.min_range_m) & (ranges <= sensor.max_range_m)
    return np.where(seen, noisy, np.inf).astype(np.float32)
