"""EKF-SLAM with stereo landmarks, the classical comparison of gil2008 (its refs. 8, 24 to 26).

One Gaussian over the robot's pose and all landmarks, with all their correlations; so there is one
association for the whole filter, and a wrong one is never taken back.
"""

import math
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from estimators.base import Belief, Prior
from estimators.gaussian import STILL, Gaussian, compose, wrap
from estimators.options import require_choices
from estimators.slam_frontend import Association, Image, SlamFrontEnd
from estimators.stereo import LEAST_DEPTH_M, NoiseAt, NoiseModel
from estimators.wheels import WheelPrediction
from sim.arrays import Array, Ints
from sim.recording import Frame
from sim.sensors import Reading

Errors = Literal["coordinates", "invariant"]

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
    errors
        What the covariance is of. `coordinates`: the differences of headings and positions.
        `invariant`: the turn and shift of the whole map about the origin of the map frame, and what
        is left of each landmark: x = R(e_turn) x_hat + e_x for every position x, the robot's too.
        What is seen does not change with the turn, so no update can make the heading of the whole
        map look known, which linearising at ever other estimates does (Barrau and Bonnabel, "An
        EKF-SLAM algorithm with consistency properties", 2015).
    gate_probability, repeat_s
        Of known ids, as in `estimators.slam_frontend.SlamFrontEnd`: misread ones are left out, and
        a landmark counts once in `repeat_s`.
    kr, kl
        Believed slip variance per metre of the wheels, m.
    forward_slip_m
        Believed variance per metre of what both wheels slip together, m.
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
        errors: Errors = "coordinates",
        gate_probability: float | None = None,
        repeat_s: float = 0.0,
        kr: float = 5e-5,
        kl: float = 5e-5,
        forward_slip_m: float = 0.0,
        window_s: float = 0.05,
        keep_map: bool = False,
        stereo: str = "stereo",
    ) -> None:
        self.stereo = stereo
        require_choices(errors=(errors, Errors))
        self.invariant = errors == "invariant"
        self.wheels = WheelPrediction(kr, kl, window_s, forward_slip_m=forward_slip_m)
        self.front_end = SlamFrontEnd(
            "ekf_slam",
            stereo,
            association,
            d0,
            noise_model,
            noise_at,
            gate_probability,
            repeat_s,
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
            extras = self._see(seen, frame.stamp)
        pose = Gaussian(self._mean[:3], self._pose_covariance()).then(self._motion)
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
        blocks = P[3:, 3:].reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n)].reshape(n, 3, 3)
        means = self._mean[3:].reshape(n, 3).copy()
        if self.invariant:
            arm = _quarter_turned(means)
            mixed = arm[:, :, None] * P[2, 3:].reshape(n, 1, 3)
            blocks = blocks + mixed + mixed.transpose(0, 2, 1)
            blocks += P[2, 2] * arm[:, :, None] * arm[:, None, :]
        return self.front_end.map(means, blocks, slice(n))

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
        if self.invariant:
            # a turn of the robot alone is one of the whole map, and of the landmarks back
            self._mean[:3], self._motion = mean, STILL
            by_noise = np.zeros((len(P), 3))
            by_noise[:3] = np.eye(3)
            by_noise[:2, 2] = -_quarter_turned(mean)[:2]
            by_noise[3:, 2] = -_quarter_turned(self._mean[3:].reshape(-1, 3)).ravel()
            P += by_noise @ ((noise + noise.T) / 2.0) @ by_noise.T
            return
        P[:3, :3] = by_pose @ P[:3, :3] @ by_pose.T + (noise + noise.T) / 2.0
        P[:3, 3:] = by_pose @ P[:3, 3:]
        P[3:, :3] = P[:3, 3:].T
        self._mean[:3] = mean
        self._motion = STILL

    def _see(self, seen: Reading, stamp_s: float) -> dict[str, Any]:
        """Take in one image; the extras that it gives."""
        image = self.front_end.read(seen, stamp_s)
        extras: dict[str, Any] = {"status": image.status} if image.status else {}
        if len(image.points) > _MOST_OBSERVATIONS:
            image = image.of(np.arange(len(image.points)) < _MOST_OBSERVATIONS)
            extras["status"] = f"observations beyond {_MOST_OBSERVATIONS} rejected"
        slots = (
            self.front_end.known(image)
            if self.front_end.association == "known"
            else self._associate(image.points, self.front_end.unlikeness(image))
        )
        if self.front_end.gated and len(slots):
            passed = self._passed(image, slots)
            image, slots = image.of(passed), slots[passed]
        self.front_end.counted(image, stamp_s)
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

    def _passed(self, image: Image, slots: Ints) -> NDArray[np.bool_]:
        """Which observations (K,) of landmarks in these slots, -1 for new ones, pass the gate."""
        old = slots[slots >= 0]
        predicted = self._camera.predict(self._mean[:3], self._mean[3:].reshape(-1, 3)[old])[0]
        v, R = self._camera.innovation(predicted, image.points[slots >= 0])
        S = self._predicted_spread(old) + R
        distances = np.sum(v * np.linalg.solve(S, v[..., None])[..., 0], axis=-1)
        return self.front_end.passed(image, slots, distances, self._mean[:3])

    def _predicted_spread(self, slots: Ints) -> Array:
        """H P H^T (n, 3, 3) of each of these landmarks apart."""
        P = self._covariance
        _, of_pose, of_landmark = self._predict(self._mean[3:].reshape(-1, 3)[slots])
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
        predicted, of_pose, of_landmark = self._predict(self._mean[3:].reshape(-1, 3)[slots])
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
        self._correct(HP.T @ cho_solve(factor, v.ravel()))
        half = solve_triangular(factor[0], HP, lower=True)
        P -= half.T @ half  # symmetric to the last bit
        return True

    def _correct(self, by: Array) -> None:
        """Correct the mean by an error (n,): added, or a motion of the whole map."""
        if self.invariant:
            turn = float(by[2])
            R, V = _exponential(turn)
            blocks = self._mean.reshape(-1, 3)  # pose and landmarks
            blocks[:, :2] = blocks[:, :2] @ R.T + by.reshape(-1, 3)[:, :2] @ V.T
            self._mean[5::3] += by[5::3]
            self._mean[2] += turn
        else:
            self._mean += by
        self._mean[2] = wrap(float(self._mean[2]))

    def _predict(self, landmarks: Array) -> tuple[Array, Array, Array]:
        """Predicted points of landmarks (K, 3) and their derivatives by the errors."""
        predicted, of_pose, of_landmark = self._camera.predict(self._mean[:3], landmarks)
        if self.invariant:
            of_pose = of_pose * [1.0, 1.0, 0.0]
        return predicted, of_pose, of_landmark

    def _pose_covariance(self) -> Array:
        """Covariance (3, 3) of the pose's coordinates."""
        P = self._covariance[:3, :3]
        if not self.invariant:
            return P
        by_error = np.eye(3)
        by_error[:2, 2] = _quarter_turned(self._mean[:3])[:2]
        covariance: Array = by_error @ P @ by_error.T
        return covariance

    def _create(self, points: Array) -> None:
        """Append landmarks at points (K, 3), gil2008, eqs. (16)-(18), with their correlations."""
        pose, before, n = self._mean[:3], len(self._mean), 3 * len(points)
        placed = self._camera.place(np.tile(pose, (len(points), 1)), points)
        predicted, of_pose, of_landmark = self._predict(placed)
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


def _quarter_turned(points: Array) -> Array:
    """Points (..., 3) turned by a quarter about the map's origin, level: d(R(a) x) / da at 0."""
    x, y = points[..., 0], points[..., 1]
    return np.stack([-y, x, np.zeros_like(x)], axis=-1)


def _exponential(turn_rad: float) -> tuple[Array, Array]:
    """R and V (2, 2) of exp: positions become R x + V e."""
    cos, sin = math.cos(turn_rad), math.sin(turn_rad)
    along, across = np.sinc(turn_rad / math.pi), (1.0 - cos) / turn_rad if turn_rad else 0.0
    return np.array([[cos, -sin], [sin, cos]]), np.array([[along, -across], [across, along]])
