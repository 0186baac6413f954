"""The wheel encoders."""

import numpy as np

from sim.options import Positive, options
from sim.sensors.base import Probe, Schema


@options("sensors.encoder")
class Encoder:
    """Wheel encoders, read at every Frame.

    Their readings are the wheel increments that every Frame has.
    """

    rate_hz: Positive | None = 20.0
    """Readings per second of their own; null: read whenever another sensor fires."""

    @property
    def schema(self) -> Schema:
        """No fields: see `Frame.wheel_increments_m`."""
        return {}

    def start(self, rng: np.random.Generator) -> Probe:
        """Probe without a reading."""
        return lambda view: None
