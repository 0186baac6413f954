"""EKF-SLAM with stereo landmarks, the classical comparison of gil2008 (its refs. 8, 24 to 26).

One Gaussian over the robot's pose and all landmarks, with all their correlations; so there is one
association for the whole filter, and a wrong one is never taken back.
"""

import math
from typing import Any

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from estimators.base import Belief, Prior
from estimators.gaussian import STILL, Gaussian, compose, wrap
from estimators.slam_frontend import Association, SlamFrontEnd
from estimators.stereo import LEAST_DEPTH_M, NoiseAt, NoiseModel
from estimators.wheels import WheelPrediction
from sim.arrays import Array, Ints
from sim.recording import Frame
from sim.sensors import Reading

# One covariance holds the correlations of all landmarks: 1.2 GB of it
_MOST_LANDMARKS, _MOST_OBSERVATIONS = 4000, 1000


class EkfSlam:
    """Extended Kalman filter over pose and landmarks.

    At an image the motion since the last one is applied, the landmarks seen are associated, all of
    them update the state at once, and those not in the map enter it with their correlations.

    Parameters
    ----------
    association
        `known`: by the ids that the sensor gives. `mahalanobis`: least distance below `d0`,
        gil2008, eq. (15). `descriptor`: of those below `d0`, the one that distance and descriptor
        together favour.
    d0
        Threshold of the squared Mahalanobis distance (99.9 % of three degrees of freedom).
    noise_model, noise_at
        As in `estimators.stereo.StereoModel.of`.
    sigma_column_px, sigma_row_px, sigma_disparity_px, sigma_descriptor
        Believed noise; None for that of the prior's camera.
    kr, kl
        Believed slip variance per metre of the wheels, m.
    window_s
        |ds| is netted over at least this time.
    keep_map
        Put the map into every Belief.

    Notes
    -----
    Extras: `associations` (K,): for each observation, counted from 0 over the whole run, the one
    that started its landmark, itself if it is the first, -1 if it was rejected; with `keep_map`
    also `landmarks` (N, 3) and `landmark_covariances` (N, 3, 3); `status` when an image was not
    used.

    A step costs O(K N^2): the whole covariance is touched. So the map holds at most 4000 landmarks;
    `status` says when it is full, and when an image has more than 1000 observations.
    """

    needs = frozenset({"stereo"})

    def __init__(
        self,
        association: Association = "known",
        d0: float = 16.27,
        noise_model: NoiseModel = "camera",
        noise_at: NoiseAt = "predicted",
        sigma_column_px: float | None = None,
        sigma_row_px: float | None = None,
        sigma_disparity_px: float | None = None,
        sigma_descriptor: float | None = None,
        kr: float = 5e-5,
        kl: float = 5e-5,
        window_s: float = 0.05,
        keep_map: bool = False,
        stereo: str = "stereo",
    ) -> None:
        self.stereo = stereo
        self.wheels = WheelPrediction(kr, kl, window_s)
        self.front_end = SlamFrontEnd(
            "ekf_slam",
            stereo,
            association,
            d0,
            noise_model,
            noise_at,
            sigma_column_px=sigma_column_px,
            sigma_row_px=sigma_row_px,
            sigma_disparity_px=sigma_disparity_px,
            sigma_descriptor=sigma_descriptor,
        )
        self.keep_map = keep_map

    def reset(self, prior: Prior, rng: np.random.Generator) -> None:
        """Start from the prior's pose, with an empty map."""
        start = self.front_end.reset(prior)
        self._camera = self.front_end.camera
        self.wheels.reset(prior.robot.track_m)
        self._mean, self._room = start.mean, start.covariance
        self._motion = STILL  # since the last image

    def step(self, frame: Frame) -> Belief:
        """Roll by the wheels; at an image, associate, update, and add new landmarks."""
        self._motion = self._motion.then(self.wheels.predict(frame))
        extras: dict[str, Any] = {}
        seen = frame.readings.get(self.stereo)
        if seen is not None:
            self._move()
            extras = self._see(seen)
        pose = Gaussian(self._mean[:3], self._covariance[:3, :3]).then(self._motion)
        if self.keep_map:
            extras |= {k: v for k, v in self.map.items() if k.startswith("landmark")}
        return Belief(pose.mean.copy(), (pose.covariance + pose.covariance.T) / 2.0, extras)

    @property
    def map(self) -> dict[str, Array | Ints]:
        """`landmarks` (N, 3) and `landmark_covariances` (N, 3, 3), m in map.

        `origins` (N,) are the observations, counted over the run, that started them; `ids` (N,)
        are the sensor's, if it gives any.
        """
        n, P = self._n_landmarks, self._covariance
        blocks = P[3:, 3:].reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n)]
        means = self._mean[3:].reshape(n, 3).copy()
        return self.front_end.map(means, blocks.reshape(n, 3, 3), slice(n))

    @property
    def _n_landmarks(self) -> int:
        return len(self._mean) // 3 - 1

    @property
    def _covariance(self) -> Array:
        """The part of the allotted room that is in use."""
        n = len(self._mean)
        return self._room[:n, :n]

    def _move(self) -> None:
        """Apply the motion since the last image to the pose and to its correlations."""
        P = self._covariance
        mean, by_pose, by_motion = compose(self._mean[:3], self._motion.mean)
        noise = by_motion @ self._motion.covariance @ by_motion.T
        P[:3, :3] = by_pose @ P[:3, :3] @ by_pose.T + (noise + noise.T) / 2.0
        P[:3, 3:] = by_pose @ P[:3, 3:]
        P[3:, :3] = P[:3, 3:].T
        self._mean[:3] = mean
        self._motion = STILL

    def _see(self, seen: Reading) -> dict[str, Any]:
        """Take in one image; the extras that it gives."""
        image = self.front_end.read(seen)
        extras: dict[str, Any] = {"status": image.status} if image.status else {}
        if len(image.points) > _MOST_OBSERVATIONS:
            image = image.of(np.arange(len(image.points)) < _MOST_OBSERVATIONS)
            extras["status"] = f"observations beyond {_MOST_OBSERVATIONS} rejected"
        slots = (
            self.front_end.known(image)
            if self.front_end.association == "known"
            else self._associate(image.points, self.front_end.unlikeness(image))
        )
        old = slots >= 0
        fits = old | (np.cumsum(~old) <= _MOST_LANDMARKS - self._n_landmarks)
        if not fits.all():
            image, slots, old = image.of(fits), slots[fits], old[fits]
            extras["status"] = f"map full: landmarks beyond {_MOST_LANDMARKS} rejected"
        if old.any() and not self._update(slots[old], image.points[old]):
            extras["status"] = "update rejected: broken covariance, not positive definite"
        if not old.all():
            self._create(image.points[~old])
            self.front_end.start(image, ~old)
        extras["associations"] = self.front_end.associations(image, slots)
        return extras

    def _associate(self, points: Array, unlikeness: Array) -> Ints:
        """Slot (K,) of each point, -1 for new ones; a landmark at most once an image."""
        slots = np.full(len(points), -1)
        if len(points) == 0 or self._n_landmarks == 0:
            return slots
        predicted = self._camera.predict(self._mean[:3], self._mean[3:].reshape(-1, 3))[0]
        near = predicted[:, 2] > LEAST_DEPTH_M
        candidates = np.flatnonzero(
            near & (np.linalg.norm(predicted, axis=1) < self.front_end.reach_m)
        )
        if len(candidates) == 0:
            return slots
        spread = self._predicted_spread(candidates)
        v, R = self._camera.innovation(predicted[None, candidates], points[:, None])
        S = spread + R  # (K, candidates, 3, 3), or the same for all points
        distances = np.sum(v * np.linalg.solve(S, v[..., None])[..., 0], axis=-1)
        scores = np.where(distances < self.front_end.d0, distances, np.inf)
        if unlikeness.shape[1] > 0:
            unlike = unlikeness[:, candidates]
            scores = np.where(unlike > 0.0, np.inf, scores + unlike)
        for k, score in enumerate(scores):
            best = int(np.argmin(score))
            if math.isfinite(score[best]):
                slots[k] = candidates[best]
                scores[:, best] = np.inf
        return slots

    def _predicted_spread(self, slots: Ints) -> Array:
        """H P H^T (n, 3, 3) of each of these landmarks apart."""
        P = self._covariance
        _, of_pose, of_landmark = self._camera.predict(
            self._mean[:3], self._mean[3:].reshape(-1, 3)[slots]
        )
        at = 3 + 3 * slots[:, None] + np.arange(3)
        cross = P[:3][:, at].transpose(1, 0, 2)
        own = P[at[:, :, None], at[:, None, :]]
        turned = of_landmark.transpose(0, 2, 1)
        mixed = of_pose @ cross @ turned
        spread: Array = (
            of_pose @ P[:3, :3] @ of_pose.transpose(0, 2, 1) + of_landmark @ own @ turned
        )
        return spread + mixed + mixed.transpose(0, 2, 1)

    def _update(self, slots: Ints, points: Array) -> bool:
        """Kalman update by points (K, 3) of landmarks in these slots, all at once.

        Rejected, with False, if rounding has left the innovation without a proper covariance.
        """
        P, n = self._covariance, 3 * len(slots)
        predicted, of_pose, of_landmark = self._camera.predict(
            self._mean[:3], self._mean[3:].reshape(-1, 3)[slots]
        )
        v, R = self._camera.innovation(predicted, points)
        at = 3 + 3 * slots[:, None] + np.arange(3)
        rows = P[at].reshape(len(slots), 3, -1)
        HP = (of_pose @ P[:3] + of_landmark @ rows).reshape(n, -1)  # H has two blocks a row
        along = HP[:, at].reshape(n, len(slots), 3).transpose(1, 0, 2)
        S = HP[:, :3] @ of_pose.reshape(n, 3).T
        S += (along @ of_landmark.transpose(0, 2, 1)).transpose(1, 0, 2).reshape(n, n)
        for k in range(len(slots)):
            S[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += R[k]
        try:
            factor = cho_factor((S + S.T) / 2.0, lower=True)
        except np.linalg.LinAlgError:
            return False
        self._mean += HP.T @ cho_solve(factor, v.ravel())
        self._mean[2] = wrap(float(self._mean[2]))
        half = solve_triangular(factor[0], HP, lower=True)
        P -= half.T @ half  # symmetric to the last bit
        return True

    def _create(self, points: Array) -> None:
        """Append landmarks at points (K, 3), gil2008, eqs. (16)-(18), with their correlations."""
        pose, before, n = self._mean[:3], len(self._mean), 3 * len(points)
        placed = self._camera.place(np.tile(pose, (len(points), 1)), points)
        predicted, of_pose, of_landmark = self._camera.predict(pose, placed)
        # p = C (l - t(pose)) and so l = t(pose) + C^T p
        C_T = of_landmark.transpose(0, 2, 1)
        by_pose = -(C_T @ of_pose).reshape(n, 3)
        R = self._camera.innovation(predicted, points)[1]
        after = before + n
        if after > len(self._room):
            wanted = min(after + after // 2, 3 + 3 * _MOST_LANDMARKS)
            self._room = np.pad(self._covariance, (0, wanted - before))
        P = self._room[:after, :after]
        P[before:, :before] = by_pose @ P[:3, :before]
        P[:before, before:] = P[before:, :before].T
        own = by_pose @ P[:3, :3] @ by_pose.T
        for k, block in enumerate(C_T @ R @ of_landmark):
            own[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += block
        P[before:, before:] = (own + own.T) / 2.0
        self._mean = np.concatenate([self._mean, placed.ravel()])
