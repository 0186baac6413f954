"""A beacon like GPS: a position in map with white noise, an error that wanders, and gaps."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from sim.sensors import Field, View


@dataclass(frozen=True)
class Beacon:
    """Where base_link is, (2,) m in map."""

    rate_hz: float = 2.0
    sigma_m: float = 0.05
    wander_m: float = 0.02  # in a second; it grows with the square root of the time
    missing: float = 0.2  # share of readings that fail

    schema: ClassVar[Mapping[str, Field]] = {"position_m": Field("m", shape=(2,), in_map=True)}

    def start(self, rng: np.random.Generator):
        """Begin a drive: the error that wanders is the probe's own."""
        wander_m = np.zeros(2)

        def probe(view: View):
            nonlocal wander_m
            wander_m = wander_m + self.wander_m * view.duration_s**0.5 * rng.standard_normal(2)
            if rng.random() < self.missing:
                return None
            return {"position_m": view.pose[:2] + wander_m + self.sigma_m * rng.standard_normal(2)}

        return probe
