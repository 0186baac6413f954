"""A gyroscope about the vertical axis."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from sim.sensors.base import Field, Probe, Reading, Schema, View
from sim.settings import check_numbers


@dataclass(frozen=True)
class Gyroscope:
    """Mean yaw rate since its last reading, with white noise and a bias that walks.

    Parameters
    ----------
    rate_hz
        Readings per second.
    sigma_rate_radps
        Standard deviation of the white noise of a reading.
    sigma_bias_radps
        Standard deviation of the bias at the start.
    bias_walk_radps_per_sqrt_s
        Standard deviation by which the bias has walked after one second; it grows with the square
        root of the time.
    """

    ros_message: ClassVar = "sensor_msgs/msg/Imu"
    ros_topic: ClassVar = "/imu"

    rate_hz: float = 100.0
    sigma_rate_radps: float = 0.005
    sigma_bias_radps: float = 0.01
    bias_walk_radps_per_sqrt_s: float = 1e-4

    def __post_init__(self) -> None:
        check_numbers(
            "sensors.gyroscope",
            self,
            ("rate_hz",),
            ("sigma_rate_radps", "sigma_bias_radps", "bias_walk_radps_per_sqrt_s"),
        )

    @property
    def schema(self) -> Schema:
        """Yaw rate, counter-clockwise; the true bias beside it."""
        return {
            "yaw_rate_radps": Field("rad/s"),
            "bias_radps": Field("rad/s", truth=True),
        }

    def start(self, rng: np.random.Generator) -> Probe:
        """Probe with a bias of its own."""
        bias = self.sigma_bias_radps * rng.standard_normal()

        def probe(view: View) -> Reading | None:
            nonlocal bias
            if view.duration_s == 0.0:
                return None  # nothing to take the mean over
            white, step = rng.standard_normal(2)
            bias += self.bias_walk_radps_per_sqrt_s * math.sqrt(view.duration_s) * step
            rate = view.motion[2] / view.duration_s + bias + self.sigma_rate_radps * white
            return {"yaw_rate_radps": np.array(rate), "bias_radps": np.array(bias)}

        return probe

    def to_ros(self, reading: Reading) -> dict[str, Any]:
        """Fields of an Imu without an orientation and accelerations."""
        absent = np.zeros(9)
        absent[0] = -1.0
        covariance = np.zeros(9)
        covariance[8] = self.sigma_rate_radps**2
        return {
            "angular_velocity": {"z": float(reading["yaw_rate_radps"])},
            "angular_velocity_covariance": covariance,
            "orientation_covariance": absent,
            "linear_acceleration_covariance": absent,
        }

    def from_ros(self, message: Any) -> Reading:
        """Reading of an Imu."""
        return {"yaw_rate_radps": np.array(message.angular_velocity.z)}
