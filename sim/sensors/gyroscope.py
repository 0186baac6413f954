"""A gyroscope about the vertical axis."""

import math
from typing import Any, ClassVar

import numpy as np

from sim.options import NonNegative, Positive, options
from sim.sensors.base import Field, Probe, Reading, Schema, View


@options("sensors.gyroscope")
class Gyroscope:
    """Mean yaw rate since its last reading, with white noise and a bias that walks."""

    ros_message: ClassVar = "sensor_msgs/msg/Imu"
    ros_topic: ClassVar = "/imu"

    rate_hz: Positive = 100.0
    """Readings per second."""
    sigma_rate_radps: NonNegative = 0.005
    """Standard deviation of the white noise of a reading."""
    sigma_bias_radps: NonNegative = 0.01
    """Standard deviation of the bias at the start."""
    bias_walk_radps_per_sqrt_s: NonNegative = 1e-4
    """Standard deviation by which the bias has walked after one second; it grows with the square
    root of the time."""

    @property
    def schema(self) -> Schema:
        """Yaw rate, counter-clockwise, and the true bias."""
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
