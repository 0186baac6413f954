"""Odometry by registration of laser scans (decristoforis2020, sec. II-B and III).

Each scan is registered against the previous one, eq. (5), or against a key frame, and its
covariance is composed along.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from estimators import icp_covariance
from estimators.base import Belief, Prior
from estimators.icp import Metric, PreparedScan, Registration, Search, prepare, register
from sim import se2
from sim.errors import InputError
from sim.recording import Frame
from sim.robot import TravelWindow, arc_increment, arc_increment_jacobian, wheel_variances

Array = NDArray[np.float64]
Reference = Literal["previous", "keyframe"]
Covariance = Literal["censi", "censi_last", "hessian", "sampling", "unscented_censi"]

FAILED = ("empty", "poor_overlap", "not_converged")

_LEAST_SIGMA_M = 1e-4  # a laser without noise still has rounding
# What a guess may be wrong by, at least and at most
_LEAST_GATE_M, _MOST_GATE_M = 0.5, 2.0
_LEAST_GATE_RAD, _MOST_GATE_RAD = 0.02, 0.2
_HEADING_WINDOW_RAD = math.pi / 6.0  # constant velocity misses the turns: search the headings
# Constant velocity is not trusted further than to these standard deviations
_GUESS_FLOOR_M, _GUESS_FLOOR_RAD, _GUESS_SHARE = 0.05, 0.05, 0.5


@dataclass(frozen=True)
class _Gaussian:
    """A pose (3,) and its covariance (3, 3), or a motion and its."""

    mean: Array
    covariance: Array

    def then(self, motion: _Gaussian) -> _Gaussian:
        """Compose with an independent motion."""
        by_pose, by_motion = se2.compose_jacobians(self.mean, motion.mean)
        covariance = by_pose @ self.covariance @ by_pose.T
        covariance += by_motion @ motion.covariance @ by_motion.T
        return _Gaussian(se2.compose(self.mean, motion.mean), covariance)

    def seen_from(self, T_base_sensor: Array) -> _Gaussian:
        """The same motion of a sensor that sits at this pose on the moving body."""
        back = se2.inverse(T_base_sensor)
        half = se2.compose(back, self.mean)
        by_motion = se2.compose_jacobians(back, self.mean)[1]
        by_motion = se2.compose_jacobians(half, T_base_sensor)[0] @ by_motion
        covariance = by_motion @ self.covariance @ by_motion.T
        return _Gaussian(se2.compose(half, T_base_sensor), covariance)


_STILL = _Gaussian(np.zeros(3), np.zeros((3, 3)))


@dataclass(frozen=True)
class _Anchor:
    """A scan and the belief in base_link when it was taken; no scan before the first."""

    belief: _Gaussian
    scan: PreparedScan | None


class IcpOdometry:
    """Compose registrations of scans.

    Parameters
    ----------
    metric, search
        As in `estimators.icp.register`.
    reference
        What a scan is registered against: the `previous` scan (decristoforis2020, eq. (5)), or a
        `keyframe`, kept until the robot has left it by more than the thresholds.
    keyframe_distance_m, keyframe_turn_rad
        How far the robot goes before it takes a new key frame.
    use_odometry_guess
        Start registrations from the wheel increments. Without it they start from constant
        velocity, and the wheels are not used at all.
    covariance
        Method of `estimators.icp_covariance`; `censi_last` counts the noise of the last scan
        only, as the paper prints it. Point to point by `censi` lets matches slide.
    sigma_range_m
        Believed range noise; None for that of the prior's laser.
    kr, kl
        Believed slip variance per metre of the wheels, m, for the guess.
    window_s
        |ds| is netted over at least this time.

    Notes
    -----
    When a registration fails (against the reference and against the last scan), the belief moves
    by the guess with the guess's covariance and `extras["status"]` says why. The next scan is
    tried against both again; after a second failure the newest scan becomes the reference.
    Directions that the scans do not hold keep the guess and its covariance. Frames without a
    scan move by the wheels with `use_odometry_guess`, else they repeat the last belief.

    Belief extras: `registration_covariance` (3, 3) of T_reference_base, `registration_status`,
    and `status` if the registration failed.
    """

    needs = frozenset({"laser"})

    def __init__(
        self,
        metric: Metric = "point_to_line",
        reference: Reference = "keyframe",
        keyframe_distance_m: float = 0.5,
        keyframe_turn_rad: float = 0.35,
        use_odometry_guess: bool = True,
        covariance: Covariance = "censi",
        sigma_range_m: float | None = None,
        search: Search = "angular",
        kr: float = 1e-4,
        kl: float = 1e-4,
        window_s: float = 0.05,
    ) -> None:
        choices = {
            "metric": (metric, ("point_to_line", "point_to_point")),
            "reference": (reference, ("previous", "keyframe")),
            "search": (search, ("angular", "kdtree")),
            "covariance": (
                covariance,
                ("censi", "censi_last", "hessian", "sampling", "unscented_censi"),
            ),
        }
        for name, (value, allowed) in choices.items():
            if value not in allowed:
                raise InputError(f"estimator.{name} must be {' or '.join(allowed)}, got {value!r}")
        numbers = {
            "keyframe_distance_m": keyframe_distance_m,
            "keyframe_turn_rad": keyframe_turn_rad,
            "kr": kr,
            "kl": kl,
            "window_s": window_s,
        }
        if sigma_range_m is not None:
            numbers["sigma_range_m"] = sigma_range_m
        for name, number in numbers.items():
            if not (math.isfinite(number) and number >= 0.0):
                raise InputError(f"estimator.{name} must be zero or positive, got {number}")
        self.metric, self.reference, self.search = metric, reference, search
        self.keyframe_distance_m, self.keyframe_turn_rad = keyframe_distance_m, keyframe_turn_rad
        self.use_odometry_guess, self.covariance = use_odometry_guess, covariance
        self.sigma_range_m, self.kr, self.kl, self.window_s = sigma_range_m, kr, kl, window_s

    def reset(self, prior: Prior, rng: np.random.Generator) -> None:
        """Start from the prior's pose; the first scan becomes the reference."""
        laser = prior.sensors.laser
        if laser is None:
            raise InputError("icp_odometry needs a laser; choose sensors that have one")
        if prior.mean is None or prior.covariance is None:
            raise InputError("icp_odometry needs a start pose; set prior.start=tracking")
        self._rng = rng
        self._bearings, self._max_range_m = laser.bearings_rad, laser.max_range_m
        sigma = laser.sigma_range_m if self.sigma_range_m is None else self.sigma_range_m
        self._sigma_m = max(sigma, _LEAST_SIGMA_M)
        self._T_base_laser = laser.mount.pose
        self._track_m = prior.robot.track_m
        self._window = TravelWindow(self.window_s)
        start = _Gaussian(prior.mean.copy(), prior.covariance.copy())
        self._key = self._last = _Anchor(start, None)
        self._key_to_last = _STILL
        self._lost = False
        self._wheels = _STILL  # motion since the last scan, by the wheels
        self._since_s = 0.0
        self._velocity = np.zeros(3)  # twist between the last two scans, per second

    def step(self, frame: Frame) -> Belief:
        """Register the Frame's scan, if it has one, and compose."""
        self._since_s += frame.duration_s
        if self.use_odometry_guess:
            self._roll(frame)
        if frame.ranges_m is None:
            return _belief(self._last.belief.then(self._wheels), {})
        scan = prepare(frame.ranges_m, self._bearings, self._max_range_m)
        guess = self._guess()
        belief = self._last.belief.then(guess)
        if len(scan) < 3:
            return _belief(belief, {"registration_status": "empty", "status": "empty"})
        if self._last.scan is None:
            self._key = self._last = _Anchor(self._last.belief.then(self._wheels), scan)
            self._wheels, self._since_s = _STILL, 0.0
            return _belief(self._last.belief, {"registration_status": "first"})
        extras: dict[str, Any] = {}
        references = [(self._key, self._key_to_last)]
        if self._key is not self._last:
            references.append((self._last, _STILL))  # tried if the key frame is lost
        for anchor, so_far in references:
            assert anchor.scan is not None
            motion, status = self._matched(scan, anchor.scan, so_far.then(guess))
            extras["registration_status"] = status
            if status not in FAILED:
                extras["registration_covariance"] = motion.covariance
                belief = anchor.belief.then(motion)
                self._key, self._key_to_last = anchor, motion
                break
        failed = status in FAILED
        if failed:
            extras["status"] = status
            self._key_to_last = self._key_to_last.then(guess)
        if self._since_s > 0.0:
            moved = se2.between(self._last.belief.mean, belief.mean)
            self._velocity = se2.log(moved) / self._since_s
        self._last = _Anchor(belief, scan)
        # after a single lost scan the key frame gets another chance: the scan may be at fault
        if (failed and self._lost) or (not failed and self._left_key()):
            self._key, self._key_to_last = self._last, _STILL
        self._lost = failed
        self._wheels, self._since_s = _STILL, 0.0
        return _belief(belief, extras)

    def _roll(self, frame: Frame) -> None:
        """Add the Frame's wheel increments to the motion since the last scan."""
        travel = frame.wheel_increments_m
        spread_m = self._window.push(frame.duration_s, travel)
        G = arc_increment_jacobian(travel, self._track_m)
        Q = G @ np.diag(wheel_variances(spread_m, self.kr, self.kl)) @ G.T
        self._wheels = self._wheels.then(_Gaussian(arc_increment(travel, self._track_m), Q))

    def _guess(self) -> _Gaussian:
        """Motion since the last scan, before this one is looked at."""
        if self.use_odometry_guess:
            return self._wheels
        motion = se2.exp(self._velocity * self._since_s)
        spread_m = _GUESS_FLOOR_M + _GUESS_SHARE * math.hypot(motion[0], motion[1])
        spread_rad = _GUESS_FLOOR_RAD + _GUESS_SHARE * abs(float(motion[2]))
        return _Gaussian(motion, np.diag([spread_m**2, spread_m**2, spread_rad**2]))

    def _left_key(self) -> bool:
        """Whether it is time for a new key frame."""
        if self.reference == "previous":
            return True
        x, y, turn = self._key_to_last.mean
        return math.hypot(x, y) > self.keyframe_distance_m or abs(turn) > self.keyframe_turn_rad

    def _matched(
        self, scan: PreparedScan, reference: PreparedScan, guess: _Gaussian
    ) -> tuple[_Gaussian, str]:
        """Motion of base_link from the reference to the scan, and the registration's status."""
        in_laser = guess.seen_from(self._T_base_laser)
        spread_m = math.sqrt(in_laser.covariance[0, 0] + in_laser.covariance[1, 1])
        spread_rad = math.sqrt(in_laser.covariance[2, 2])
        found = register(
            scan,
            reference,
            in_laser.mean,
            metric=self.metric,
            search=self.search,
            gate_m=min(_LEAST_GATE_M + 4.0 * spread_m, _MOST_GATE_M),
            gate_rad=min(_LEAST_GATE_RAD + 4.0 * spread_rad, _MOST_GATE_RAD),
            heading_window_rad=0.0 if self.use_odometry_guess else _HEADING_WINDOW_RAD,
        )
        if found.status in FAILED:
            return guess, found.status
        R = self._covariance_of(found, scan, reference, in_laser.covariance)
        motion = _Gaussian(found.T_target_source, R)
        if found.status == "degenerate":
            motion = _completed(motion, found, in_laser)
        return motion.seen_from(se2.inverse(self._T_base_laser)), found.status

    def _covariance_of(
        self, found: Registration, source: PreparedScan, target: PreparedScan, of_guess: Array
    ) -> Array:
        sigma = self._sigma_m
        if self.covariance == "hessian":
            return icp_covariance.hessian(found)
        if self.covariance == "sampling":
            return icp_covariance.sampling(
                found, source, target, self._rng, sigma, search=self.search
            )
        if self.covariance == "unscented_censi":
            return icp_covariance.unscented_censi(
                found, source, target, of_guess, sigma, matches="sliding", search=self.search
            )
        scans: icp_covariance.Scans = "last" if self.covariance == "censi_last" else "both"
        return icp_covariance.censi(found, source, target, sigma, scans=scans, matches="sliding")


def _completed(motion: _Gaussian, found: Registration, guess: _Gaussian) -> _Gaussian:
    """In the directions that the scans do not hold, the guess and its covariance."""
    held, loose = icp_covariance.split_directions(found)
    coordinates = np.linalg.inv(np.hstack([held, loose]))[held.shape[1] :]
    off = motion.mean - guess.mean
    off[2] = math.remainder(off[2], 2.0 * math.pi)
    share = loose @ coordinates
    mean = motion.mean - share @ off
    # every method of covariance has put `loose @ loose.T` there
    covariance = motion.covariance - loose @ loose.T + share @ guess.covariance @ share.T
    return _Gaussian(mean, (covariance + covariance.T) / 2.0)


def _belief(belief: _Gaussian, extras: dict[str, Any]) -> Belief:
    return Belief(belief.mean.copy(), belief.covariance.copy(), extras)
