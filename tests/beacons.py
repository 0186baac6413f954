"""A sensor from outside the package: receivers of beacons, which need no change in `sim/`."""

from dataclasses import dataclass, field

import numpy as np

from sim.errors import InputError
from sim.sensors import Field, Mount


@dataclass(frozen=True)
class Beacons:
    """Ranges to the landmarks in reach; it has every kind of field, and a battery that drains."""

    rate_hz: float = 5.0
    reach_m: float = 4.0
    sigma_range_m: float = 0.1
    drain_v_per_s: float = 0.01
    channels: int | None = 2
    mount: Mount = field(default_factory=lambda: Mount(x_m=0.1))

    def __post_init__(self):
        if self.reach_m <= 0.0:
            raise InputError(f"reach_m must be positive, got {self.reach_m}")

    @property
    def schema(self):
        return {
            "battery_v": Field("V"),
            "strength": Field("", "f4", (None,)),
            "ranges_m": Field("m", ragged=True),
            "ids": Field("", "i4", ragged=True),
            "colours": Field("", "u1", (3,), ragged=True),
            "true_ranges_m": Field("m", ragged=True, truth=True),
            "temperature": Field("K", "f4", truth=True),
        }

    def start(self, rng):
        return _Receiver(self, rng)


class _Receiver:
    def __init__(self, sensor, rng):
        self._sensor, self._rng, self._battery_v = sensor, rng, 5.0

    def begin(self, view):
        """Wear: a number that is drawn once a drive."""
        self._worn_v = 0.1 * self._rng.random()

    def __call__(self, view):
        sensor = self._sensor
        self._battery_v -= sensor.drain_v_per_s * view.duration_s
        here = sensor.mount.in_map(view.pose)[:2]
        away_m = np.linalg.norm(view.world.landmarks[:, :2] - here, axis=1)
        ids = np.flatnonzero(away_m < sensor.reach_m)
        noise = self._rng.standard_normal(len(ids))
        return {
            "battery_v": self._battery_v - self._worn_v,
            "strength": np.full(sensor.channels, view.stamp),
            "ranges_m": away_m[ids] + sensor.sigma_range_m * noise,
            "ids": ids,
            "colours": np.column_stack([ids % 256] * 3),
            "true_ranges_m": away_m[ids],
            "temperature": 290.0,
        }


@dataclass(frozen=True)
class Forgetful(Beacons):
    """It leaves out a field that its schema has."""

    def start(self, rng):
        return lambda view: {"battery_v": 5.0}


@dataclass(frozen=True)
class HiddenRows(Beacons):
    """Rows that only the truth has: nothing says which reading they belong to."""

    @property
    def schema(self):
        return {"count": Field("", "i4"), "true_ranges_m": Field("m", ragged=True, truth=True)}


@dataclass(frozen=True)
class BadName(Beacons):
    """A field whose name the log needs for itself."""

    @property
    def schema(self):
        return {"stamps": Field("s")}


@dataclass(frozen=True)
class Compass:
    """A heading as a standard message, though its class is not the package's."""

    ros_message = "sensor_msgs/msg/Imu"
    ros_topic = "/compass"

    rate_hz: float = 10.0

    @property
    def schema(self):
        return {"heading_rad": Field("rad")}

    def start(self, rng):
        return lambda view: {"heading_rad": view.pose[2]}

    def to_ros(self, reading):
        half = float(reading["heading_rad"]) / 2.0
        return {"orientation": {"z": np.sin(half), "w": np.cos(half)}}
