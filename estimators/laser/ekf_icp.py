"""Fusion of wheels and laser in an extended Kalman filter with a clone of the key frame's pose.

decristoforis2020 fuses both as velocities (`estimators.laser.ekf_icp_paper`). Here registrations
measure what they are: the pose of a scan relative to that of a key frame. The state therefore
holds the key frame's pose beside the robot's (stochastic cloning; Roumeliotis and Burdick 2002).

Errors are twists in map (an invariant filter; Barrau and Bonnabel 2017): with errors of
coordinates, registrations would spuriously inform the absolute heading once it is uncertain.
"""

import dataclasses
import math
from typing import Annotated, Any

import numpy as np
from pydantic import Field
from scipy.special import chdtri

from estimators.base import Belief, Prior
from estimators.gaussian import STILL, Gaussian, between, compose, rotate, wrap
from estimators.laser.icp import PreparedScan, Rules
from estimators.laser.remembered import RememberedPoses
from estimators.laser.scan_matching import (
    KeyFrameOptions,
    Match,
    MatcherOptions,
    bias_sigmas,
    exceeds,
)
from estimators.laser.sweep import skew_covariance
from estimators.lost import Unexplained
from estimators.wheels import EncoderTickOptions, WheelPrediction
from sim import se2
from sim.arrays import Array
from sim.errors import require
from sim.options import NonNegative, Probability, Share, options
from sim.recording import Frame

_PATIENCE = 2  # scans in a row that may fail before the newest becomes the key frame
_ORIGIN_STEP_M = 1e4  # the start is taken this near to the origin: twists lose digits far from it
_TINY = 1e-14  # keeps the update with a noiseless measurement solvable
# Places in the state: key frame, last scan, robot, then the remembered key frames; for the time of
# an update the newest scan stands before those
_KEY, _LAST, _POSE, _NEW = (slice(3 * i, 3 * i + 3) for i in range(4))
_REVISITED = 0.7  # share of the thresholds of key frames within which one is taken up again
_SEEN_AGAIN = 0.5  # share of a scan that a remembered key frame should see as well
_MOST_WEAKENED = 150.0  # times its variance that the innovation of one may have
_REVISIT_M = 0.5  # standard deviation of where it is; at more, graph_slam has to close the loop
# Slip that the wheels' noise does not describe
_AGREES = 1e-3  # share of registrations of a scan that differ more if they err as believed
_BORNE_OUT = 3.0  # points more that have to bear it out than the wheels
_RELEARNT = 0.1  # weight of a scan in how much the wheels are believed to slip
_MOST_SURPRISED = 4.0  # times the usual innovation that one scan may teach of it
_NEGLIGIBLE_M2 = 1e-10


@options("estimator")
class EkfIcpOptions(EncoderTickOptions, KeyFrameOptions, Rules, MatcherOptions):
    """Options of the filter with a clone of the key frame's pose."""

    register_distance_m: NonNegative = 0.0
    """How far the robot is believed to go before another scan is registered, m: it must exceed
    this or `register_turn_rad`. 0 and 0: every scan is. One cannot be set without the other."""
    register_turn_rad: NonNegative = 0.0
    """How far it is believed to turn before that, rad."""
    gate_probability: Probability | None = 1e-9
    """Reject a registration if only this share of all should have a larger innovation; null: use
    all. The default rejects only what must be a wrong match."""
    keyframe_distance_m: NonNegative = 1.0
    keyframe_turn_rad: NonNegative = 0.7
    remembered: Annotated[int, Field(ge=0, le=1000)] = 100
    """Key frames that are remembered besides the one in use, those left last. A new one is
    registered with that of them which it should see again and which would teach most."""
    shared_noise: Share = 0.75
    """Share of a registration's covariance that comes from the scans' own errors, half from
    each; 0: registrations are independent. Registrations before and after a key frame then
    correlate by minus half of it."""

    def __post_init__(self) -> None:
        require(
            (self.register_distance_m > 0.0) == (self.register_turn_rad > 0.0),
            "estimator.register_distance_m and register_turn_rad go together, since a scan is "
            "registered once either is exceeded: set both, or neither",
        )


class EkfIcp(EkfIcpOptions):
    """Predict by the wheels, correct by the scan's pose relative to the key frame.

    Each scan is modelled as seen from an apparent pose, x * d, whose error d enters all its
    registrations; the rest of the noise is independent from one registration to the next. A
    registration compares apparent poses, and those of the key frame and of the last scan are in
    the state. So the noise that all registrations of a key frame share is counted once, and a
    scan's error cancels when it turns from source to reference.

    Notes
    -----
    Where the registration with the key frame fails or is gated, the last scan is tried, and
    becomes the key frame if it succeeds. Where both fail only the wheels are used; after two such
    scans in a row the newest becomes the key frame. Directions that the scans do not constrain
    are left to the wheels.

    Where only the gate stands against a registration with the key frame, a second scan decides
    (the last one that was registered, or after a change of key frame the old one). If its
    registration agrees, the wheels are taken to have slipped by what kr and kl do not describe,
    and go on being believed less until registrations are foretold again.

    Belief extras: `registration_covariance` (3, 3) of T_reference_base, `registration_status`,
    `nis` (normalised innovation squared) with `nis_dof`, `slip_burst` if one was assumed, and
    `status` if a scan was not used; `lost`, from 0 to 1.
    """

    needs = frozenset({"laser"})

    def reset(self, prior: Prior, rng: np.random.Generator) -> None:
        """Start from the prior's pose; the first scan becomes the key frame."""
        self._laser, self._rng = prior.require_laser(self.laser, "ekf_icp"), rng
        start = prior.require_start("ekf_icp")
        self._origin = np.append(np.rint(start.mean[:2] / _ORIGIN_STEP_M) * _ORIGIN_STEP_M, 0.0)
        start = Gaussian(start.mean - self._origin, start.covariance)
        self._wheels = WheelPrediction(self, prior.robot.track_m)
        self._key: PreparedScan | None = None
        self._last: PreparedScan | None = None
        # of the key frame's first degenerate match, as twists: as in `Match`
        self._directions: tuple[Array, Array] | None = None
        self._remembered: list[PreparedScan] = []
        # (9,): apparent poses of the key frame and of the last scan, pose of base_link; in map,
        # less its origin here
        self._mean = np.tile(start.mean, 3)
        # of the twists in map that take the means to the true poses
        to_twist = _from_twist(-start.mean)
        self._covariance = np.tile(to_twist @ start.covariance @ to_twist.T, (3, 3))
        # derivative of their errors by the laser's biases, which no gain follows (Schmidt 1966)
        self._by_bias = np.zeros((9, 2))
        self._biases_m2 = np.diag(np.square(bias_sigmas(self._laser)))
        self._skew = np.zeros((3, 3))  # of the newest scan, as base_link sees it
        self._old = RememberedPoses(9)
        self._failures = 0
        # a scan whose pose in the key frame was registered, and the key frame's pose in it
        self._witness: tuple[PreparedScan, Gaussian] | None = None
        self._slip_m2 = 0.0  # variance of a wheel's slip from scan to scan besides kr and kl
        self._unexplained = Unexplained()
        share = self.gate_probability
        self._gates = [math.inf if share is None else chdtri(d, share) for d in range(4)]

    def step(self, frame: Frame) -> Belief:
        """Predict by the wheels; correct by the Frame's scan, if it has one."""
        moved = self._predict(frame)
        extras: dict[str, Any] = {}
        scan = frame.readings.get(self.laser)
        if scan is not None and self._is_due():
            prepared = self.matcher.prepare(scan["ranges_m"], self._laser, moved, frame.duration_s)
            self._correct(prepared, extras)
            if prepared is not None:  # without returns nothing denies the pose
                self._unexplained.note(frame.stamp, "status" in extras, 1)
        by_twist, by_bias = _from_twist(self._mean[_POSE]), self._by_bias[_POSE]
        covariance = self._covariance[_POSE, _POSE] + by_bias @ self._biases_m2 @ by_bias.T
        covariance = by_twist @ covariance @ by_twist.T
        mean = self._mean[_POSE] + self._origin
        if scan is not None:
            extras["lost"] = self._unexplained.lost(frame.stamp, covariance)
        return Belief(mean, (covariance + covariance.T) / 2.0, extras)

    def _predict(self, frame: Frame) -> Array:
        """Move the robot's pose by the wheels, and return the motion; the clones stay."""
        motion = self._wheels.predict(frame)
        self._skew = skew_covariance(self._laser, motion.covariance, frame.duration_s)
        self._mean[_POSE], _, by_motion = compose(self._mean[_POSE], motion.mean)
        by_motion = _from_twist(-self._mean[_POSE]) @ by_motion
        self._covariance[_POSE, _POSE] += by_motion @ motion.covariance @ by_motion.T
        return motion.mean

    def _is_due(self) -> bool:
        """Whether a scan is to be registered, by the motion since the last one that was."""
        if self._last is None or not (self.register_distance_m or self.register_turn_rad):
            return True
        moved, _, _ = between(self._mean[_LAST], self._mean[_POSE])
        return exceeds(moved, self.register_distance_m, self.register_turn_rad)

    def _correct(self, scan: PreparedScan | None, extras: dict[str, Any]) -> None:
        """Register the scan against the key frame, or else the last scan, and take it in."""
        if scan is None:
            extras["registration_status"] = extras["status"] = "empty"
            return
        if self._key is None or self._last is None:
            extras["registration_status"] = "first"
            self._insert(self._own_noise(scan))
            return self._keep(scan, scan, (_NEW, _NEW))
        if self._slip_m2:
            self._slip(self._slip_m2)
        references = [(_KEY, self._key), (_LAST, self._last)]
        for place, reference in references[: 1 if self._last is self._key else 2]:
            expected, _ = self._expected(place)
            match = self.matcher.match(scan, reference, expected, self._laser, self._rng)
            extras["registration_status"] = match.status
            if match.failed:
                continue
            if place is _KEY:
                match = self._as_before(match)
            taken = self._take_in(match, place, extras)
            if not taken and place is _KEY and self._witnessed(scan, match, expected):
                taken = self._take_in_as_slip(match, expected, place, extras)
            if taken:
                return self._go_on(scan, match, place, reference, extras)
            extras["registration_status"] = "gated"
        extras["status"] = extras["registration_status"]
        self._insert(self._own_noise(scan))
        self._failures += 1
        lost = self._failures >= _PATIENCE
        if lost:
            self._witness = None
        return self._keep(scan if lost else self._key, scan, (_NEW if lost else _KEY, _NEW))

    def _go_on(
        self,
        scan: PreparedScan,
        match: Match,
        place: slice,
        reference: PreparedScan,
        extras: dict[str, Any],
    ) -> None:
        """Keep the reference as key frame, or take up another, or the registered scan."""
        self._failures = 0
        self._relearn_slip(extras["nis"], extras["nis_dof"])
        if not self.left_key_frame(match.motion.mean):
            self._witness = scan, _inverse(match.motion)
            return self._keep(reference, scan, (place, _NEW))
        revisited = self._revisit(scan, extras)
        if revisited is None:
            self._witness = reference, match.motion
            return self._keep(scan, scan, (_NEW, _NEW))
        key, source, motion = revisited
        self._witness = scan, _inverse(motion)
        self._keep(key, scan, (source, _NEW))

    def _revisit(
        self, scan: PreparedScan, extras: dict[str, Any]
    ) -> tuple[PreparedScan, slice, Gaussian] | None:
        """Register a scan, which is in the state, with a remembered key frame that it sees again.

        Returns that key frame, with its place and the scan's pose in it, if it is near enough to be
        the reference.
        """
        self._expand()
        apart = se2.between(self._mean[12:].reshape(-1, 3), self._mean[_POSE])
        best, most_m2 = None, 0.0
        for i, other in enumerate(self._remembered[:-1]):  # the last one was left just before
            place = slice(12 + 3 * i, 15 + 3 * i)
            if self.matcher.seen_again(scan, other, apart[i], self._laser) < _SEEN_AGAIN:
                continue
            spread_m2 = float(np.trace(self._expected(place, _NEW)[0].covariance[:2, :2]))
            if most_m2 < spread_m2 < _REVISIT_M**2:
                best, most_m2 = i, spread_m2
        if best is None:
            return None
        place, reference = slice(12 + 3 * best, 15 + 3 * best), self._remembered[best]
        expected, _ = self._expected(place, _NEW)
        match = self.matcher.match(scan, reference, expected, self._laser, self._rng)
        if match.status != "ok":
            return None
        found: dict[str, Any] = {}
        taken = self._update(match, place, found, weaken=True)
        if "weakened" in found or not taken:
            extras["status"] = "inconsistent"
        if not taken:
            return None
        far_m, far_rad = self.keyframe_distance_m, self.keyframe_turn_rad
        if exceeds(apart[best], _REVISITED * far_m, _REVISITED * far_rad):
            return None
        return reference, place, match.motion

    def _expected(self, place: slice, pose: slice = _POSE) -> tuple[Gaussian, Array]:
        """Pose relative to a clone's, with its covariance; its derivative (3, 3) by the twists.

        A twist that both poses share changes nothing, so the derivative by the clone's twist is
        minus that by the robot's: the filter learns nothing that the scans do not measure.
        """
        relative, _, by_pose = between(self._mean[place], self._mean[pose])
        by_twist = by_pose @ _from_twist(self._mean[pose])
        P = self._covariance
        cross = P[place, pose]
        spread = P[place, place] + P[pose, pose] - cross - cross.T
        return Gaussian(relative, by_twist @ spread @ by_twist.T), by_twist

    def _take_in(self, match: Match, place: slice, extras: dict[str, Any]) -> bool:
        """Append the scan's apparent pose to the state, and correct it by the registration.

        Returns False, with the state as before, if the innovation lies outside the gate.
        """
        before = self._mean, self._covariance, self._by_bias, self._old.factor
        shared = self.shared_noise / 2.0 * match.known_covariance
        self._insert(rotate(shared, self._mean[place][2]))
        if taken := self._update(match, place, extras):
            return taken
        self._mean, self._covariance, self._by_bias, self._old.factor = before
        return False

    def _update(
        self, match: Match, place: slice, extras: dict[str, Any], *, weaken: bool = False
    ) -> bool:
        """Correct the state by the pose of the newest scan in that of another.

        Returns False, with the state as before, if the innovation lies outside the gate. With
        `weaken` it may lie further off, but counts only as far as it would then be usual.
        """
        expected, by_twist = self._expected(place, _NEW)
        C, R, P = match.held, match.motion.covariance, self._covariance
        off = match.motion.mean - expected.mean
        off[2] = wrap(off[2])
        innovation, by_twist = C @ off, C @ by_twist
        extras["registration_covariance"] = R
        # the halves of what is shared are in the state already
        noise = (1.0 - self.shared_noise) * C @ R @ C.T + _TINY * np.eye(len(C))
        cross = (P[:, _NEW] - P[:, place]) @ by_twist.T
        S = by_twist @ (cross[_NEW] - cross[place]) + noise
        nis = float(innovation @ np.linalg.solve(S, innovation)) if len(C) else 0.0
        extras["nis"], extras["nis_dof"] = nis, len(C)
        if nis > self._gates[len(C)]:
            if not weaken or nis > _MOST_WEAKENED * len(C):
                return False
            extras["weakened"] = True
            S = S * (nis / len(C))
        gain = np.asarray(np.linalg.solve(S, cross.T).T, dtype=np.float64)
        lost = (cross - gain @ (S / 2.0)) @ gain.T
        self._covariance = P - lost - lost.T
        off_by_bias = by_twist @ (self._by_bias[_NEW] - self._by_bias[place]) + C @ match.by_bias
        off_by_bias = np.column_stack([innovation, off_by_bias])
        self._old.learn(by_twist, place, _NEW, S, off_by_bias, gain)
        self._by_bias = self._by_bias - gain @ off_by_bias[:, 1:]
        twists = (gain @ innovation).reshape(-1, 3)
        self._mean = se2.compose(se2.exp(twists), self._mean.reshape(-1, 3)).ravel()
        return True

    def _witnessed(self, scan: PreparedScan, match: Match, guess: Gaussian) -> bool:
        """Whether another scan sees this one where its registration with the key frame does.

        Both start from the wheels' guess (of T_key_scan), so if they agree, the wheels are wrong;
        unless the scans fit there as well, as along a corridor, where both err alike.
        """
        if self._witness is None or self._key is None:
            return False
        if self.matcher.borne_out_by(scan, self._key, match, guess, self._laser) < _BORNE_OUT:
            return False
        other, T_other_key = self._witness
        second = self.matcher.match(scan, other, T_other_key.then(guess), self._laser, self._rng)
        if second.failed or not len(second.held):
            return False
        first = T_other_key.then(match.motion)
        off = second.motion.mean - first.mean
        off[2] = wrap(off[2])
        off = second.held @ off
        S = second.held @ (first.covariance + second.motion.covariance) @ second.held.T
        return bool(off @ np.linalg.solve(S, off) < chdtri(len(off), _AGREES))

    def _take_in_as_slip(
        self, match: Match, expected: Gaussian, place: slice, extras: dict[str, Any]
    ) -> bool:
        """Take a registration in as `_take_in` does, its innovation explained by the wheels."""
        off = match.motion.mean - expected.mean
        slip_m = math.hypot(*off[:2]) + self._wheels.track_m / 2.0 * abs(wrap(off[2]))
        before = self._covariance
        self._slip(slip_m**2)
        if taken := self._take_in(match, place, extras):
            self._slip_m2 += _RELEARNT * max(slip_m**2 - self._slip_m2, 0.0)
            extras["slip_burst"] = True
        else:
            self._covariance = before
        return taken

    def _slip(self, slip_m2: float) -> None:
        """Widen the robot's pose by slip of the wheels, of this variance."""
        per_m = 2.0 / self._wheels.track_m
        to_twist = _from_twist(-self._mean[_POSE])
        self._covariance = self._covariance.copy()
        spread = np.diag([slip_m2, slip_m2, per_m**2 * slip_m2])
        self._covariance[_POSE, _POSE] += to_twist @ spread @ to_twist.T

    def _relearn_slip(self, nis: float, dof: int) -> None:
        """Follow how far registrations lie off what the wheels foretell."""
        if self._slip_m2 and dof:
            surprise = min(nis / dof, _MOST_SURPRISED)
            self._slip_m2 *= 1.0 + _RELEARNT * (surprise - 1.0)
            if self._slip_m2 < _NEGLIGIBLE_M2:
                self._slip_m2 = 0.0

    def _as_before(self, match: Match) -> Match:
        """Give a degenerate match the directions of the key frame's first such match.

        Each registration finds slightly different unconstrained directions, and together they
        would seem to constrain them. As twists in the key frame the directions are the same
        wherever the robot is.
        """
        if match.status != "degenerate":
            return match
        to_motion, to_twist = _from_twist(match.motion.mean), _from_twist(-match.motion.mean)
        if self._directions is None or len(self._directions[0]) != len(match.held):
            self._directions = match.held @ to_motion, to_twist @ match.loose @ to_motion
        held, loose = self._directions
        return dataclasses.replace(match, held=held @ to_twist, loose=to_motion @ loose @ to_twist)

    def _insert(self, noise: Array) -> None:
        """Append the newest scan's apparent pose to the state: that of base_link, and noise.

        The noise (3, 3) is in the coordinates of map. A scan of a laser that sweeps errs besides by
        what the wheels did during the sweep.
        """
        noise = noise + rotate(self._skew, self._mean[8])
        to_twist = _from_twist(-self._mean[_POSE])
        self._select(_KEY, _LAST, _POSE, _POSE, slice(9, None))
        self._covariance[_NEW, _NEW] += to_twist @ noise @ to_twist.T

    def _select(self, *places: slice) -> None:
        """Make these the places of the state, in this order."""
        every = np.arange(len(self._mean))
        rows = np.concatenate([every[place] for place in places])
        self._mean, self._covariance = self._mean[rows], self._covariance[np.ix_(rows, rows)]
        self._by_bias = self._by_bias[rows]
        self._old.select(rows)

    def _expand(self) -> None:
        """Append the remembered poses to the state."""
        self._mean, self._covariance, self._by_bias = self._old.join(
            self._mean, self._covariance, self._by_bias
        )

    def _keep(self, key: PreparedScan, last: PreparedScan, places: tuple[slice, slice]) -> None:
        """Keep two of the apparent poses, the robot's, and those of remembered key frames."""
        if key is self._key:
            self._last = last
            return self._select(*places, _POSE)
        self._directions = None
        self._expand()
        others = {12 + 3 * i: scan for i, scan in enumerate(self._remembered)}
        others.pop(places[0].start, None)
        if self._key is not None:
            others[_KEY.start] = self._key
        kept = list(others)[max(len(others) - self.remembered, 0) :]
        self._remembered = [others[first] for first in kept]
        self._key, self._last = key, last
        self._select(*places, _POSE, *(slice(first, first + 3) for first in kept))
        self._old = RememberedPoses(9, self._mean, self._covariance, self._by_bias)
        self._mean, self._covariance = self._mean[:9], self._covariance[:9, :9]
        self._by_bias = self._by_bias[:9]

    def _own_noise(self, scan: PreparedScan) -> Array:
        """Shared noise (3, 3) in map of a scan that was not registered: from one against itself."""
        match = self.matcher.match(scan, scan, STILL, self._laser, self._rng)
        noise = self.shared_noise / 2.0 * match.known_covariance
        return np.zeros((3, 3)) if match.failed else rotate(noise, self._mean[8])


def _from_twist(pose: Array) -> Array:
    """Derivative (3, 3) of exp(twist) * pose by the twist, at zero; for -pose its inverse."""
    x, y, _ = pose.tolist()
    return np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]])


def _inverse(motion: Gaussian) -> Gaussian:
    """The motion back."""
    mean, by_motion, _ = between(motion.mean, np.zeros(3))
    return Gaussian(mean, by_motion @ motion.covariance @ by_motion.T)
