"""Odometry by registration of laser scans (decristoforis2020, sec. II-B and III).

Each scan is registered against the previous one, eq. (5), or against a key frame, and its
covariance is composed along.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from estimators.base import Belief, Prior
from estimators.gaussian import STILL, Gaussian
from estimators.laser.icp import PreparedScan, Rules
from estimators.laser.scan_matching import KeyFrameOptions, MatcherOptions, Reference
from estimators.wheels import WheelOptions, WheelPrediction
from sim import se2
from sim.options import options
from sim.recording import Frame

_HEADING_WINDOW_RAD = math.pi / 6.0  # constant velocity misses the turns: search the headings
# Constant velocity is not trusted further than to these standard deviations
_GUESS_FLOOR_M, _GUESS_FLOOR_RAD, _GUESS_SHARE = 0.05, 0.05, 0.5


@dataclass(frozen=True)
class _Anchor:
    """A scan and the belief in base_link when it was taken; no scan before the first."""

    belief: Gaussian
    scan: PreparedScan | None


@options("estimator")
class IcpOdometryOptions(WheelOptions, KeyFrameOptions, Rules, MatcherOptions):
    """Options of odometry by registration of laser scans."""

    reference: Reference = "keyframe"
    """What a scan is registered against: the `previous` scan (decristoforis2020, eq. (5)), or a
    `keyframe`, kept until the robot has left it by more than the thresholds."""
    use_odometry_guess: bool = True
    """Start registrations from the wheel increments. Without it they start from constant velocity,
    and the wheels are not used at all."""


class IcpOdometry(IcpOdometryOptions):
    """Compose registrations of scans.

    Notes
    -----
    When a registration fails (against the reference and against the last scan), the belief moves
    by the guess with the guess's covariance and `extras["status"]` gives the reason. The next scan
    is tried against both again; after a second failure the newest scan becomes the reference.
    Directions that the scans do not constrain keep the guess and its covariance. Frames without a
    scan move by the wheels with `use_odometry_guess`, else they repeat the last belief.

    Belief extras: `registration_covariance` (3, 3) of T_reference_base, `registration_status`,
    and `status` if the registration failed.
    """

    needs = frozenset({"laser"})

    def reset(self, prior: Prior, rng: np.random.Generator) -> None:
        """Start from the prior's pose; the first scan becomes the reference."""
        self._laser, self._rng = prior.require_laser(self.laser, "icp_odometry"), rng
        self._key = self._last = _Anchor(prior.require_start("icp_odometry"), None)
        self._key_to_last = STILL
        self._lost = False
        self._heading_window_rad = 0.0 if self.use_odometry_guess else _HEADING_WINDOW_RAD
        self._wheels = WheelPrediction(self, prior.robot.track_m)
        self._rolled, self._since_s = STILL, 0.0  # since the last scan, by the wheels
        self._velocity = np.zeros(3)  # twist between the last two scans, per second

    def step(self, frame: Frame) -> Belief:
        """Register the Frame's scan, if it has one, and compose."""
        self._since_s += frame.duration_s
        if self.use_odometry_guess:
            self._rolled = self._rolled.then(self._wheels.predict(frame))
        reading = frame.readings.get(self.laser)
        if reading is None:
            return _belief(self._last.belief.then(self._rolled), {})
        guess = self._guess()
        scan = self.matcher.prepare(reading["ranges_m"], self._laser, guess.mean, self._since_s)
        belief = self._last.belief.then(guess)
        if scan is None:
            return _belief(belief, {"registration_status": "empty", "status": "empty"})
        if self._last.scan is None:
            self._key = self._last = _Anchor(self._last.belief.then(self._rolled), scan)
            self._rolled, self._since_s = STILL, 0.0
            return _belief(self._last.belief, {"registration_status": "first"})
        extras: dict[str, Any] = {}
        # the last scan is tried if the key frame is lost
        references = [(self._key, self._key_to_last), (self._last, STILL)]
        for anchor, so_far in references[: 1 if self._key is self._last else 2]:
            assert anchor.scan is not None
            expected = so_far.then(guess)
            match = self.matcher.match(
                scan, anchor.scan, expected, self._laser, self._rng, self._heading_window_rad
            )
            extras["registration_status"] = match.status
            if not match.failed:
                motion = match.complete(expected)
                extras["registration_covariance"] = motion.covariance
                belief = anchor.belief.then(motion)
                self._key, self._key_to_last = anchor, motion
                break
        failed = match.failed
        if failed:
            extras["status"] = match.status
            self._key_to_last = self._key_to_last.then(guess)
        if self._since_s > 0.0:
            moved = se2.between(self._last.belief.mean, belief.mean)
            self._velocity = se2.log(moved) / self._since_s
        self._last = _Anchor(belief, scan)
        left_key = self.reference == "previous" or self.left_key_frame(self._key_to_last.mean)
        # after a single lost scan the key frame gets another chance: the scan may be at fault
        if (failed and self._lost) or (not failed and left_key):
            self._key, self._key_to_last = self._last, STILL
        self._lost = failed
        self._rolled, self._since_s = STILL, 0.0
        return _belief(belief, extras)

    def _guess(self) -> Gaussian:
        """Motion since the last scan, before this one is looked at."""
        if self.use_odometry_guess:
            return self._rolled
        motion = se2.exp(self._velocity * self._since_s)
        spread_m = _GUESS_FLOOR_M + _GUESS_SHARE * math.hypot(motion[0], motion[1])
        spread_rad = _GUESS_FLOOR_RAD + _GUESS_SHARE * abs(float(motion[2]))
        return Gaussian(motion, np.diag([spread_m**2, spread_m**2, spread_rad**2]))


def _belief(belief: Gaussian, extras: dict[str, Any]) -> Belief:
    return Belief(belief.mean.copy(), belief.covariance.copy(), extras)
