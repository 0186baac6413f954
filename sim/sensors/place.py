"""Global descriptors of places, from a network or from whole clouds."""

from typing import Any, ClassVar

import numpy as np

import sim.sensors.point_cloud as point_cloud
from sim.errors import InputError
from sim.options import Positive, options
from sim.sensors.base import Field, Probe, Reading, Schema


@options("sensors.place")
class PlaceDescriptor:
    """One vector a place, made from other readings; it is recorded, not simulated."""

    ros_message: ClassVar = point_cloud.MESSAGE
    ros_topic: ClassVar = "/places"

    rate_hz: Positive | None = None

    @property
    def schema(self) -> Schema:
        """A descriptor of a size that the network chooses."""
        return {"descriptor": Field("", "f4", (None,))}

    def start(self, rng: np.random.Generator) -> Probe:
        """Refuse to simulate."""
        raise InputError("place descriptors are made from clouds; choose sensors=lidar3d")

    def to_ros(self, reading: Reading) -> dict[str, Any]:
        """Fields of a PointCloud2, one point a component."""
        return point_cloud.fields({"value": reading["descriptor"]})

    def from_ros(self, message: Any) -> Reading:
        """Reading of such a PointCloud2."""
        return {"descriptor": point_cloud.columns(message)["value"].astype(np.float32)}
