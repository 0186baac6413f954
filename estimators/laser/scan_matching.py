"""Registration of a robot's scans as its estimators use it: motions of base_link, with covariance.

The guess sets how far to look, the chosen method the covariance; directions that the scans do
not constrain are reported.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from estimators.base import LaserOptions
from estimators.gaussian import Gaussian
from estimators.laser import icp_covariance
from estimators.laser.icp import (
    DEFAULT_RULES,
    MIN_POINTS,
    Metric,
    PreparedScan,
    Registration,
    Rules,
    better_by,
    prepare,
    register,
    split_directions,
)
from estimators.laser.remembered import seen_again
from estimators.laser.scan_lines import without_sparse_lines
from estimators.laser.sweep import at_stamp
from sim import se2
from sim.arrays import Array
from sim.options import NonNegative, options
from sim.sensors import Laser

Covariance = Literal["censi", "censi_last", "hessian", "sampling", "unscented_censi"]
Reference = Literal["previous", "keyframe"]

FAILED = ("empty", "poor_overlap", "not_converged")

_LEAST_SIGMA_M = 1e-4  # a laser without noise still has rounding
# Bounds of the error that a guess is assumed to have
_LEAST_GATE_M, _MOST_GATE_M = 0.5, 2.0
_LEAST_GATE_RAD, _MOST_GATE_RAD = 0.02, 0.2
_EVERYTHING, _NOTHING, _UNBIASED = np.eye(3), np.zeros((3, 3)), np.zeros((3, 2))


@dataclass(frozen=True)
class Match:
    """The motion of base_link from the reference scan to another, as registered.

    Attributes
    ----------
    motion
        T_reference_base; the guess where the registration failed.
    status
        That of the `Registration`.
    held
        (D, 3) rows that take a motion to its D coordinates which the scans hold; the identity
        but for degenerate pairs.
    loose
        (3, 3) projection onto the directions that the scans do not hold.
    overlap
        Share of the scan's points that agree with the reference.
    by_bias
        (3, 2) derivative of the motion by a bias of the ranges, a length and a share; zeros for
        a laser that is not said to have one.
    """

    motion: Gaussian
    status: str
    held: Array
    loose: Array
    overlap: float
    by_bias: Array = field(default_factory=lambda: _UNBIASED)

    @property
    def failed(self) -> bool:
        """Whether the registration is useless."""
        return self.status in FAILED

    @property
    def known_covariance(self) -> Array:
        """(3, 3) the motion's covariance without the directions that the scans do not hold."""
        if self.loose is _NOTHING:
            return self.motion.covariance
        known = np.eye(3) - self.loose
        return known @ self.motion.covariance @ known.T

    def complete(self, guess: Gaussian) -> Gaussian:
        """In the directions that the scans do not hold, the guess and its covariance."""
        if self.loose is _NOTHING:
            return self.motion
        off = self.motion.mean - guess.mean
        off[2] = math.remainder(off[2], 2.0 * math.pi)
        unknown = self.motion.covariance - guess.covariance
        covariance = self.motion.covariance - self.loose @ unknown @ self.loose.T
        return Gaussian(self.motion.mean - self.loose @ off, (covariance + covariance.T) / 2.0)


def bias_sigmas(laser: Laser) -> tuple[float, float]:
    """How far all ranges of a laser may be off alike: m, and a share. Which way is not known."""
    return abs(getattr(laser, "bias_m", 0.0)), abs(getattr(laser, "bias_share", 0.0))


def exceeds(motion: Array, distance_m: float, turn_rad: float) -> bool:
    """Whether a motion (3,) has left a key frame by more than either threshold."""
    x, y, turn = motion.tolist()
    return math.hypot(x, y) > distance_m or abs(turn) > turn_rad


@options("estimator")
class MatcherOptions(LaserOptions):
    """How scans are registered, and what is believed of their noise."""

    metric: Metric = "point_to_line"
    """What registrations minimise: see `estimators.laser.icp.register`."""
    covariance: Covariance = "censi"
    """Method of `estimators.laser.icp_covariance`; `censi_last` counts the noise of the last scan
    only, as decristoforis2020 prints it. Point to point by `censi` lets matches slide."""
    sigma_range_m: NonNegative | None = None
    """Believed range noise, m; null: that of the laser."""

    @functools.cached_property
    def matcher(self) -> ScanMatcher:
        """Registers scans by these options."""
        return ScanMatcher(self)


@options("estimator")
class KeyFrameOptions:
    """How far the robot goes before it takes a new key frame: beyond either."""

    keyframe_distance_m: NonNegative = 0.5
    """Distance from a key frame at which the next is taken, m."""
    keyframe_turn_rad: NonNegative = 0.35
    """Turn from a key frame at which the next is taken, rad."""

    def left_key_frame(self, motion: Array) -> bool:
        """Whether a motion (3,) from the key frame calls for a new one."""
        return exceeds(motion, self.keyframe_distance_m, self.keyframe_turn_rad)


@dataclass(frozen=True)
class ScanMatcher:
    """Registers scans by a method's options.

    Parameters
    ----------
    believed
        The method's; those of `Rules` too, if it has them.
    max_gap_m
        Lines of which no three points in a row lie this near each other are left out; None keeps
        all.
    """

    believed: MatcherOptions
    max_gap_m: float | None = None

    @property
    def rules(self) -> Rules:
        """Which matches count, and when iterations end."""
        return self.believed if isinstance(self.believed, Rules) else DEFAULT_RULES

    @property
    def curves(self) -> bool:
        """Whether scans are cut into lines and arcs, as the metric that matches them needs it."""
        return self.believed.metric == "point_to_line"

    def prepare(
        self, ranges_m: ArrayLike, laser: Laser, moved: ArrayLike | None = None, in_s: float = 0.0
    ) -> PreparedScan | None:
        """Prepare a scan of this laser; None if it shows too little to be registered.

        With `moved`, the motion (3,) of base_link in the time `in_s` before the stamp, the beams of
        a sweep are taken to the instant of the stamp.
        """
        bearings_rad = laser.bearings_rad
        if moved is not None and getattr(laser, "sweep_s", 0.0) > 0.0:
            ranges_m, bearings_rad = at_stamp(ranges_m, laser, moved, in_s)
        scan = prepare(ranges_m, bearings_rad, laser.max_range_m, curves=self.curves)
        if self.curves:  # coarse ranges look free of noise
            scan = scan._replace(noise_m=max(scan.noise_m, self.sigma_m(laser)))
        if self.max_gap_m is not None:
            scan = without_sparse_lines(scan, self.max_gap_m)
        return scan if len(scan.points) >= MIN_POINTS else None

    def match(
        self,
        scan: PreparedScan,
        reference: PreparedScan,
        guess: Gaussian,
        laser: Laser,
        rng: np.random.Generator,
        heading_window_rad: float = 0.0,
    ) -> Match:
        """Register a scan against a reference.

        Parameters
        ----------
        guess
            T_reference_base as known before.
        laser
            Where it sits and what it may see.
        rng
            For the covariance by sampling.
        heading_window_rad
            Half the range of headings to search, where the guess knows nothing of the turn.
        """
        mount = laser.mount.pose
        in_laser, _ = guess.in_sensor(mount)
        (xx, _, _), (_, yy, _), (_, _, turn) = in_laser.covariance.tolist()
        found = register(
            scan,
            reference,
            in_laser.mean,
            metric=self.believed.metric,
            gate_m=min(_LEAST_GATE_M + 4.0 * math.sqrt(max(xx + yy, 0.0)), _MOST_GATE_M),
            gate_rad=min(_LEAST_GATE_RAD + 4.0 * math.sqrt(max(turn, 0.0)), _MOST_GATE_RAD),
            heading_window_rad=heading_window_rad,
            rules=self.rules,
        )
        if found.status in FAILED:
            return Match(guess, found.status, _NOTHING[:0], _EVERYTHING, found.overlap)
        R = self._covariance_of(
            found, scan, reference, in_laser.covariance, self.sigma_m(laser), rng
        )
        motion, to_base = Gaussian(found.T_target_source, R).in_sensor(se2.inverse(mount))
        by_bias = _UNBIASED
        if any(bias_sigmas(laser)):
            by_bias = to_base @ icp_covariance.by_bias(found, scan, reference)
        if found.status != "degenerate":
            return Match(motion, found.status, _EVERYTHING, _NOTHING, found.overlap, by_bias)
        directions = split_directions(found)
        held_in_base, loose_in_base = (to_base @ part for part in directions)
        coordinates = np.linalg.inv(np.hstack([held_in_base, loose_in_base]))
        held, loose = np.split(coordinates, [held_in_base.shape[1]])
        match = Match(motion, found.status, held, loose_in_base @ loose, found.overlap, by_bias)
        # The directions themselves are uncertain: along a loose one that is slightly off, the
        # error of the registration and of the guess leaks into the held ones.
        off = loose @ (motion.mean - guess.mean)
        spread = loose @ guess.covariance @ loose.T
        spurious = directions[1].T @ found.information_noise @ directions[1]
        leak = float(np.trace(spurious @ (np.outer(off, off) + spread)))
        covariance = motion.covariance + leak * match.known_covariance
        return dataclasses.replace(match, motion=Gaussian(motion.mean, covariance))

    def seen_again(
        self, scan: PreparedScan, other: PreparedScan, pose: Array, laser: Laser
    ) -> float:
        """Share of a scan's points that another scan should show, by T_other_scan of base_link."""
        mount = laser.mount.pose
        in_laser = se2.compose(se2.compose(se2.inverse(mount), pose), mount)
        return seen_again(scan, other, in_laser)

    def borne_out_by(
        self,
        scan: PreparedScan,
        reference: PreparedScan,
        match: Match,
        guess: Gaussian,
        laser: Laser,
    ) -> float:
        """How many points more bear out a match than the guess (see `icp.better_by`)."""
        at, instead = (each.in_sensor(laser.mount.pose)[0] for each in (match.motion, guess))
        noise_m = max(scan.noise_m, reference.noise_m)
        return better_by(scan, reference, at.mean, instead.mean, noise_m)

    def sigma_m(self, laser: Laser) -> float:
        """Believed range noise, m."""
        sigma = self.believed.sigma_range_m
        return max(laser.sigma_range_m if sigma is None else sigma, _LEAST_SIGMA_M)

    def _covariance_of(
        self,
        found: Registration,
        source: PreparedScan,
        target: PreparedScan,
        of_guess: Array,
        sigma_m: float,
        rng: np.random.Generator,
    ) -> Array:
        if self.believed.covariance == "hessian":
            return icp_covariance.hessian(found)
        if self.believed.covariance == "sampling":
            return icp_covariance.sampling(found, source, target, rng, sigma_m, rules=self.rules)
        if self.believed.covariance == "unscented_censi":
            return icp_covariance.unscented_censi(
                found, source, target, of_guess, sigma_m, matches="sliding", rules=self.rules
            )
        scans: icp_covariance.Scans = "last" if self.believed.covariance == "censi_last" else "both"
        if self.curves:
            noise_m = max(source.noise_m, target.noise_m)
            scale = icp_covariance.misfit(
                target, found.matches, found.weights, found.residuals_m, len(target.lines)
            )
            sigma_m = max(sigma_m, noise_m * math.sqrt(scale))
        return icp_covariance.censi(found, source, target, sigma_m, scans=scans, matches="sliding")
