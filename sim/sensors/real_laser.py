"""A laser with the faults of real ones: short readings, missing readings and dropped scans."""

from typing import Annotated

import numpy as np
from pydantic import Field, Strict

from sim.arrays import Array, Bools, Ints
from sim.errors import require
from sim.options import Share, options
from sim.sensors.base import Probe, Reading, View
from sim.sensors.laser import Laser

Neighbours = Annotated[float, Field(ge=1.0)]
Stamps = Annotated[tuple[float, ...], Strict(False), "numbers of seconds that increase"]


@options("sensors.laser")
class RealLaser(Laser):
    """A laser whose beams may end before the wall, or not come back."""

    short_share: Share = 0.0
    """Of the beams that would hit a wall, the share that end anywhere before it, such as on someone
    who walks by (Thrun, Burgard, Fox 2005, sec. 6.3)."""
    short_beams: Neighbours = 1.0
    """Over how many neighbours it is settled whether they do."""
    missing_share: Share = 0.0
    """Of the others, the share that do not come back."""
    missing_beams: Neighbours = 1.0
    """Over how many neighbours it is settled whether they do."""
    stamps: Stamps | None = None
    """When it scans, s from the start: at the first firing from each of them on; null: at every
    firing."""

    def __post_init__(self) -> None:
        super().__post_init__()
        increasing = self.stamps is None or bool((np.diff(self.stamps) > 0.0).all())
        require(increasing, "sensors.laser.stamps must be numbers of seconds that increase")

    def start(self, rng: np.random.Generator) -> Probe:
        """Probe that casts the beams and corrupts some of them."""
        due = iter(self.stamps or ())
        next_s = next(due, np.inf) if self.stamps is not None else -np.inf

        def probe(view: View) -> Reading | None:
            nonlocal next_s
            if view.stamp < next_s - 1e-9:
                return None
            while next_s <= view.stamp + 1e-9 and self.stamps is not None:
                next_s = next(due, np.inf)
            return {"ranges_m": self.measure(self._spoilt(view.scan(self), rng), rng)}

        return probe

    def _spoilt(self, true_m: Array, rng: np.random.Generator) -> Array:
        """True ranges (beams,) m, some of them shorter, some inf."""
        short, leader = _settled(len(true_m), self.short_share, self.short_beams, rng)
        missing, _ = _settled(len(true_m), self.missing_share, self.missing_beams, rng)
        obstacle_m = np.minimum((rng.random(len(true_m)) * true_m)[leader], true_m)
        ends_m = np.where(missing, np.inf, true_m)
        return np.where(short & np.isfinite(true_m), obstacle_m, ends_m)


def _settled(n: int, share: float, together: float, rng: np.random.Generator) -> tuple[Bools, Ints]:
    """Whether each of n beams fails, and the first of its group of neighbours, which fail alike."""
    begins = rng.random(n) < 1.0 / together
    begins[0] = True
    leader = np.maximum.accumulate(np.where(begins, np.arange(n), 0))
    return (rng.random(n) < share)[leader], leader
