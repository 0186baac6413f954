"""The wheel encoders."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sim.sensors.base import Probe, Schema
from sim.settings import check_numbers


@dataclass(frozen=True)
class Encoder:
    """Wheel encoders; read at every Frame, and at `rate_hz` on their own if it is not None.

    Their readings are the wheel increments that every Frame has.
    """

    rate_hz: float | None = 20.0

    def __post_init__(self) -> None:
        if self.rate_hz is not None:
            check_numbers("sensors.encoder", self, ("rate_hz",))

    @property
    def schema(self) -> Schema:
        """No fields: see `Frame.wheel_increments_m`."""
        return {}

    def start(self, rng: np.random.Generator) -> Probe:
        """Probe without a reading."""
        return lambda view: None
