"""A laser with the faults of real ones.

Short readings, missing readings and dropped scans; noise and bias by range and incidence, mixed
pixels at edges, glass and dark faces.
"""

from typing import Annotated

import numpy as np
from pydantic import Field, Strict

from sim.arrays import Array, ArrayLike, Bools, Floats, Ints
from sim.errors import require
from sim.options import Acute, NonNegative, Positive, Share, options
from sim.sensors.base import Hits, Probe, Reading, View
from sim.sensors.laser import Laser
from sim.worlds.world import REMISSION, Material

_LEAST_COSINE = 0.05  # nearer to grazing the noise does not grow
_LEAST_JUMP_M = 0.05
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

    sigma_share: NonNegative = 0.0
    """Further noise: standard deviation as a share of the range."""
    bias_m: float = 0.0
    """Mean error of the range."""
    bias_share: float = 0.0
    """Mean error as a share of the range."""
    bias_incidence_m: float = 0.0
    """Mean error at an angle of incidence of 60 degrees; at another angle a it is (1 / cos a - 1)
    times as large (Laconte et al. 2019, "Lidar measurement bias estimation via return waveform
    modelling", for its shape)."""
    divergence_rad: NonNegative = 0.0
    """Angle of the beam, to 1 / e^2 of its middle. On a face at an angle of incidence a the range r
    has the further noise r divergence / 4 tan a, the spot's standard deviation along the beam."""
    mixed_m: NonNegative = 0.0
    """Of a beam half on an edge, the largest jump over which both returns blend into one between
    them, anywhere; of a larger one the beam's middle decides. 0: no mixed pixels."""
    glass_angle_rad: Acute | None = None
    """Angle of incidence below which glass returns a beam; others pass. null: glass is a wall."""
    reach_at_10_percent_m: Positive | None = None
    """Range to a face of 10 percent remission; it grows with the root of remission and of the
    cosine of incidence. null: every face returns."""
    nothing_m: NonNegative | None = None
    """What is recorded where nothing returns, at min_range_m or below, or at max_range_m or beyond;
    null: +inf."""

    def __post_init__(self) -> None:
        super().__post_init__()
        nothing = self.nothing_m
        require(
            nothing is None or not self.min_range_m < nothing < self.max_range_m,
            "sensors.laser.nothing_m must not lie between min_range_m and max_range_m, got "
            f"{nothing}",
        )
        require(
            self.mixed_m == 0.0 or self.divergence_rad > 0.0,
            "sensors.laser.mixed_m needs a beam of some width; set divergence_rad",
        )
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
            return {"ranges_m": self._measured(view, rng)}

        return probe

    def _measured(self, view: View, rng: np.random.Generator) -> Floats:
        """Ranges (n_beams,) as they are recorded."""
        plain = (self.sigma_share, self.bias_incidence_m, self.divergence_rad) == (0.0, 0.0, 0.0)
        if plain and self.glass_angle_rad is None and self.reach_at_10_percent_m is None:
            true_m, cosines = view.scan(self), np.ones(self.n_beams)
        else:
            true_m, cosines = self._returns(view, rng)
        ranges = self._noisy(self._spoilt(true_m, rng), cosines, rng)
        if self.nothing_m is not None:
            ranges[np.isinf(ranges)] = self.nothing_m
        return ranges

    def _returns(self, view: View, rng: np.random.Generator) -> tuple[Array, Array]:
        """True ranges (n_beams,) m of what returns, mixed at edges, and cosines of incidence."""
        middle = self._returned(view.hits(self))
        ranges = middle.ranges_m
        if self.mixed_m > 0.0:
            half = self.divergence_rad / 2.0
            sides = [self._returned(view.hits(self, turn)).ranges_m for turn in (-half, half)]
            near, far = np.minimum(*sides), np.maximum(*sides)
            with np.errstate(invalid="ignore"):
                jump = np.where(np.isfinite(far), far - near, np.inf)
            # what a slanted face spans within the beam is its noise
            slant = 1.2 * near * self.divergence_rad * _tangents(middle.cos_incidence)
            mixed = (jump > np.maximum(slant, _LEAST_JUMP_M)) & (jump <= self.mixed_m)
            share = rng.random(len(ranges))
            ranges = np.where(mixed, near + share * np.where(mixed, jump, 0.0), ranges)
        return ranges, middle.cos_incidence

    def _returned(self, hits: Hits) -> Hits:
        """What returns enough light."""
        if self.reach_at_10_percent_m is None:
            return hits
        remission = np.array([REMISSION[kind] for kind in Material])[hits.materials]
        reach = self.reach_at_10_percent_m * np.sqrt(remission * hits.cos_incidence / 0.1)
        return hits._replace(ranges_m=np.where(hits.ranges_m <= reach, hits.ranges_m, np.inf))

    def sigmas_m(self, ranges_m: ArrayLike, cos_incidence: ArrayLike = 1.0) -> Array:
        """Standard deviations of ranges (...,), m, at cosines of their angles of incidence."""
        r = np.asarray(ranges_m, float)
        spot = r * self.divergence_rad / 4.0 * _tangents(cos_incidence)
        return np.sqrt(self.sigma_range_m**2 + (self.sigma_share * r) ** 2 + spot**2)

    def biases_m(self, ranges_m: ArrayLike, cos_incidence: ArrayLike = 1.0) -> Array:
        """Mean errors of ranges (...,), m."""
        slanted = 1.0 / np.maximum(cos_incidence, _LEAST_COSINE) - 1.0
        r = np.asarray(ranges_m, float)
        return np.asarray(self.bias_m + self.bias_share * r + self.bias_incidence_m * slanted)

    def _noisy(self, true_m: Array, cosines: Array, rng: np.random.Generator) -> Floats:
        seen = (true_m >= self.min_range_m) & (true_m <= self.max_range_m)
        r = np.where(seen, true_m, 0.0)
        noise = self.sigmas_m(r, cosines) * rng.standard_normal(r.shape)
        noisy = np.maximum(r + self.biases_m(r, cosines) + noise, 0.0)
        return np.where(seen, noisy, np.inf).astype(np.float32)

    def points_in_base(self, reading: Reading) -> Array:
        """Points (N, 2), m, of the beams that saw something."""
        if self.nothing_m is None:
            return super().points_in_base(reading)
        ranges = np.asarray(reading["ranges_m"])
        seen = np.where(self.returned(ranges), ranges, np.inf)
        return super().points_in_base({"ranges_m": seen})

    def _spoilt(self, true_m: Array, rng: np.random.Generator) -> Array:
        """True ranges (beams,) m, some of them shorter, some inf."""
        short, leader = _settled(len(true_m), self.short_share, self.short_beams, rng)
        missing, _ = _settled(len(true_m), self.missing_share, self.missing_beams, rng)
        obstacle_m = np.minimum((rng.random(len(true_m)) * true_m)[leader], true_m)
        ends_m = np.where(missing, np.inf, true_m)
        return np.where(short & np.isfinite(true_m), obstacle_m, ends_m)


def _tangents(cos_incidence: ArrayLike) -> Array:
    """Tangents of angles of incidence, bounded where beams graze."""
    cosines = np.clip(cos_incidence, _LEAST_COSINE, 1.0)
    return np.asarray(np.sqrt(1.0 - cosines**2) / cosines)


def _settled(n: int, share: float, together: float, rng: np.random.Generator) -> tuple[Bools, Ints]:
    """Whether each of n beams fails, and the first of its group of neighbours, which fail alike."""
    begins = rng.random(n) < 1.0 / together
    begins[0] = True
    leader = np.maximum.accumulate(np.where(begins, np.arange(n), 0))
    return (rng.random(n) < share)[leader], leader
