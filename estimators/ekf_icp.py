"""Fusion of wheels and laser in an extended Kalman filter with a clone of the key frame's pose.

decristoforis2020 fuses both as velocities (`estimators.ekf_icp_paper`). Here registrations
measure what they are: the pose of a scan relative to that of a key frame. The state therefore
holds the key frame's pose beside the robot's (stochastic cloning; Roumeliotis and Burdick 2002).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from estimators.base import Belief, Prior
from estimators.gaussian import STILL, Gaussian, between, compose, update, wheel_motion, wrap
from estimators.icp import Metric, PreparedScan, Search
from estimators.scan_matching import (
    Covariance,
    Match,
    ScanMatcher,
    require_positive,
    tracking_start,
)
from sim.errors import InputError
from sim.recording import Frame
from sim.robot import TravelWindow, wheel_variances

Array = NDArray[np.float64]

_PATIENCE = 2  # scans in a row that may fail before the newest becomes the key frame
_TINY = 1e-14  # keeps the update with a noiseless measurement solvable


class EkfIcp:
    """Predict by the wheels, correct by the scan's pose relative to the key frame.

    Each scan is taken to show the world from an apparent pose, x * d, with an error d of its own.
    A registration compares two apparent poses. The key frame is kept in the state as its
    apparent pose, so the noise that all its registrations share is counted once, and so is the
    noise that the last registration of one key frame shares with the first of the next.

    Parameters
    ----------
    metric, search, covariance, sigma_range_m
        As in `estimators.scan_matching.ScanMatcher`; either scan bears half of the covariance.
    keyframe_distance_m, keyframe_turn_rad
        How far the robot goes before it takes a new key frame.
    kr, kl
        Believed slip variance per metre of the wheels, m.
    lateral_slip_m
        Variance per metre of the sideways slip, m.
    encoder_tick_m
        Travel of a wheel per encoder tick. Each increment that is not zero has a variance of
        tick^2 / 6, which overstates it over many frames, since ticks do not add up.
    gate_probability
        Leave out registrations whose innovation is larger than this share of all should be; None
        to use all.
    shared_noise
        Whether the noise of the key frame's scan is modelled as shared. Without it each
        registration counts as independent (for comparison).
    window_s
        |ds| is netted over at least this time.

    Notes
    -----
    A registration that failed or was gated corrects nothing. After two in a row the newest scan
    becomes the key frame. Directions that the scans do not hold are left to the wheels.

    Belief extras: `registration_covariance` (3, 3) of T_reference_base, `registration_status`,
    `nis` (the innovation squared, normalised) with `nis_dof`, and `status` if a scan was of no
    use.
    """

    needs = frozenset({"laser"})

    def __init__(
        self,
        metric: Metric = "point_to_line",
        search: Search = "angular",
        covariance: Covariance = "censi",
        sigma_range_m: float | None = None,
        keyframe_distance_m: float = 0.5,
        keyframe_turn_rad: float = 0.35,
        kr: float = 1e-4,
        kl: float = 1e-4,
        lateral_slip_m: float = 1e-7,
        encoder_tick_m: float = 0.0,
        gate_probability: float | None = None,
        shared_noise: bool = True,
        window_s: float = 0.05,
    ) -> None:
        self._matcher = ScanMatcher(metric, search, covariance, sigma_range_m)
        require_positive(
            keyframe_distance_m=keyframe_distance_m,
            keyframe_turn_rad=keyframe_turn_rad,
            kr=kr,
            kl=kl,
            lateral_slip_m=lateral_slip_m,
            encoder_tick_m=encoder_tick_m,
            window_s=window_s,
        )
        if gate_probability is not None and not 0.0 < gate_probability < 1.0:
            raise InputError(
                f"estimator.gate_probability must lie between 0 and 1 or be null, "
                f"got {gate_probability}"
            )
        self.keyframe_distance_m, self.keyframe_turn_rad = keyframe_distance_m, keyframe_turn_rad
        self.kr, self.kl, self.window_s = kr, kl, window_s
        self.lateral_slip_m, self.encoder_tick_m = lateral_slip_m, encoder_tick_m
        self.gate_probability, self.shared_noise = gate_probability, shared_noise

    def reset(self, prior: Prior, rng: np.random.Generator) -> None:
        """Start from the prior's pose; the first scan becomes the key frame."""
        start, self._laser = tracking_start(prior, "ekf_icp")
        self._rng, self._track_m = rng, prior.robot.track_m
        self._window = TravelWindow(self.window_s)
        self._key: PreparedScan | None = None
        # (6,): apparent pose of the key frame, pose of base_link; both in map
        self._mean = np.concatenate([start.mean, start.mean])
        self._covariance = np.tile(start.covariance, (2, 2))
        self._failures = 0
        share = self.gate_probability
        self._gates = [math.inf if share is None else chdtri(d, 1.0 - share) for d in range(1, 4)]

    def step(self, frame: Frame) -> Belief:
        """Predict by the wheels; correct by the Frame's scan, if it has one."""
        self._predict(frame)
        extras: dict[str, Any] = {}
        if frame.ranges_m is not None:
            self._correct(self._matcher.prepare(frame.ranges_m, self._laser), extras)
        return Belief(self._mean[3:].copy(), self._covariance[3:, 3:].copy(), extras)

    def _predict(self, frame: Frame) -> None:
        """Move the robot's pose by the wheels; the key frame's stays."""
        travel = frame.wheel_increments_m
        spread_m = self._window.push(frame.duration_s, travel)
        ticks = (travel != 0.0) * (self.encoder_tick_m**2 / 6.0)
        variances = wheel_variances(spread_m, self.kr, self.kl) + ticks
        motion = wheel_motion(travel, variances, self._track_m)[0]
        motion.covariance[1, 1] += self.lateral_slip_m * float(spread_m.mean())
        pose, by_pose, by_motion = compose(self._mean[3:], motion.mean)
        self._mean[3:] = pose
        P = self._covariance
        P[:3, 3:] = P[:3, 3:] @ by_pose.T
        P[3:, :3] = P[:3, 3:].T
        P[3:, 3:] = by_pose @ P[3:, 3:] @ by_pose.T + by_motion @ motion.covariance @ by_motion.T

    def _correct(self, scan: PreparedScan, extras: dict[str, Any]) -> None:
        """Register the scan against the key frame and take it in."""
        if len(scan) < 3:
            extras["registration_status"] = extras["status"] = "empty"
            return
        if self._key is None:
            extras["registration_status"] = "first"
            self._take_key(scan)
            return
        guess = self._expected()[0]
        found = self._matcher.match(scan, self._key, guess, self._laser, self._rng)
        status = found.status
        if not found.failed:
            extras["registration_covariance"] = found.motion.covariance
            left_key = self._left_key(found.motion.mean)
            if not self._take_in(found, left_key, extras):
                status = "gated"
        extras["registration_status"] = status
        if status in ("ok", "degenerate"):
            self._failures = 0
            if left_key:
                self._key = scan
            return
        extras["status"] = status
        self._failures += 1
        if self._failures >= _PATIENCE:
            self._take_key(scan)
            self._failures = 0

    def _expected(self) -> tuple[Gaussian, Array]:
        """Pose relative to the key frame's apparent one, and its derivative (3, 6) by the state."""
        relative, by_key, by_pose = between(self._mean[:3], self._mean[3:])
        H = np.hstack([by_key, by_pose])
        return Gaussian(relative, H @ self._covariance @ H.T), H

    def _take_in(self, found: Match, left_key: bool, extras: dict[str, Any]) -> bool:
        """Correct the state; on leaving the key frame, put this scan's apparent pose in its place.

        Returns False if the innovation lies outside the gate; the state is then as before.
        """
        expected, H = self._expected()
        C = found.held
        off = found.motion.mean - expected.mean
        off[2] = wrap(off[2])
        # a key frame that is not modelled as shared gives its half of the noise anew each time
        share = 0.5 if self.shared_noise else 1.0
        noise = C @ (share * found.motion.covariance) @ C.T
        innovation = C @ off
        S = C @ expected.covariance @ C.T + noise
        nis = float(innovation @ np.linalg.solve(S, innovation)) if len(innovation) else 0.0
        extras["nis"], extras["nis_dof"] = nis, len(innovation)
        if len(innovation) and nis > self._gates[len(innovation) - 1]:
            return False
        if left_key and self.shared_noise:
            self._insert_key(_rotated(own_noise(found), self._mean[2]))
            H = np.hstack([H[:, :3], np.zeros((3, 3)), H[:, 3:]])
            noise = _TINY * np.eye(len(innovation))
            mean, covariance = update(self._mean, self._covariance, innovation, C @ H, noise)
            order = [6, 7, 8, 3, 4, 5]
            self._set(mean[order], covariance[np.ix_(order, order)])
            return True
        self._set(*update(self._mean, self._covariance, innovation, C @ H, noise))
        if left_key:
            self._clone(np.zeros((3, 3)))
        return True

    def _insert_key(self, noise: Array) -> None:
        """Append this scan's apparent pose to the state (6,), with its own noise (3, 3) in map."""
        by_state = np.vstack([np.eye(6), np.eye(6)[3:]])
        self._mean = by_state @ self._mean
        self._covariance = by_state @ self._covariance @ by_state.T
        self._covariance[6:, 6:] += noise

    def _clone(self, noise: Array) -> None:
        """Put the robot's pose, with noise (3, 3) in map, in the place of the key frame's."""
        self._mean = np.tile(self._mean[3:], 2)
        self._covariance = np.tile(self._covariance[3:, 3:], (2, 2))
        self._covariance[:3, :3] += noise

    def _take_key(self, scan: PreparedScan) -> None:
        """Make a scan that was not registered the key frame; its own noise is against itself."""
        self._key = scan
        found = self._matcher.match(scan, scan, STILL, self._laser, self._rng)
        noise = _rotated(own_noise(found), self._mean[5])
        self._clone(noise if self.shared_noise and not found.failed else np.zeros((3, 3)))

    def _left_key(self, motion: Array) -> bool:
        """Whether it is time for a new key frame."""
        x, y, turn = motion.tolist()
        return math.hypot(x, y) > self.keyframe_distance_m or abs(turn) > self.keyframe_turn_rad

    def _set(self, mean: Array, covariance: Array) -> None:
        mean[2], mean[5] = wrap(mean[2]), wrap(mean[5])
        self._mean, self._covariance = mean, covariance


def own_noise(found: Match) -> Array:
    """Noise (3, 3) of one of the scans: half the covariance, in the directions that are held."""
    known = np.eye(3) - found.loose
    noise: Array = 0.5 * known @ found.motion.covariance @ known.T
    return noise


def _rotated(noise: Array, heading_rad: float) -> Array:
    """Covariance (3, 3) of a pose, turned by a heading."""
    cos, sin = math.cos(heading_rad), math.sin(heading_rad)
    R = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    turned: Array = R @ noise @ R.T
    return turned
