"""EKF-SLAM with stereo landmarks, the classical comparison of gil2008 (its refs. 8, 24 to 26).

One Gaussian over the robot's pose and all landmarks, with all their correlations; so there is one
association for the whole filter, and a wrong one is never taken back. Of a team it holds the poses
of all robots, and one map.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from estimators.base import Belief, Prior
from estimators.gaussian import STILL, Gaussian, compose, wrap
from estimators.options import require_positive
from estimators.sightings import Sightings, dead_reckoning, pose_by_points, team_starts
from estimators.slam_frontend import Association, Image, SlamFrontEnd
from estimators.stereo import LEAST_DEPTH_M, NoiseAt, NoiseModel
from estimators.wheels import WheelPrediction
from sim.arrays import Array, Ints
from sim.recording import Frame

# One covariance holds the correlations of all landmarks: 1.2 GB of it
_MOST_LANDMARKS, _MOST_OBSERVATIONS = 4000, 1000
# Covariance of a robot that enters the map: wide, against what is measured then
_ENTERS = np.diag(np.square([10.0, 10.0, 1.0]))
_REFINEMENTS = 5


class EkfSlam:
    """Extended Kalman filter over pose and landmarks.

    At an image the motion since the last one is applied, the landmarks seen are associated, all of
    them update the state at once, and those not in the map enter it with their correlations.

    Of a team, a sighting updates the poses of both robots. One of unknown start enters the map at
    the first instant that shows two points of it a metre apart: landmarks, robots that it sees, or
    itself as another sees it.

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
    robots
        Name of the sensor that sees the other robots of a team; None: sightings are not used.
    sighting_d0
        Squared Mahalanobis distance from which on a sighting is a misread robot, and rejected.

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
        robots: str | None = None,
        sighting_d0: float = 16.27,
    ) -> None:
        require_positive(sighting_d0=sighting_d0)
        self.stereo, self.robots, self.sighting_d0 = stereo, robots, sighting_d0
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
        self._noise = noise_model, noise_at
        self.keep_map = keep_map

    def reset(self, prior: Prior, rng: np.random.Generator) -> None:
        """Start from the prior's pose, with an empty map."""
        self.reset_team((prior,), rng)

    def reset_team(self, priors: Sequence[Prior], rng: np.random.Generator) -> None:
        """Start a team from the priors of its robots; that of robot 0 has a pose.

        Raises
        ------
        InputError
            If the robots do not carry the same sensors, or a start is unknown and the camera does
            not identify landmarks.
        """
        starts = team_starts(priors, self.front_end, "ekf_slam")
        self._sightings = Sightings.of(priors, self.robots, *self._noise, "ekf_slam")
        self._camera = self.front_end.camera
        self._wheels = dead_reckoning(self.wheels, priors)
        n = len(priors)
        self._is_placed = [start is not None for start in starts]
        self._mean, self._room = np.zeros(3 * n), np.zeros((3 * n, 3 * n))
        for robot, start in enumerate(starts):
            if start is not None:
                self._mean[_own(robot)] = start.mean
                self._room[_own(robot), _own(robot)] = start.covariance
        self._motions = [STILL] * n  # since the last image

    def step(self, frame: Frame) -> Belief:
        """Roll by the wheels; at an image, associate, update, and add new landmarks."""
        return self.step_team((frame,))[0]

    def step_team(self, frames: Sequence[Frame]) -> list[Belief]:
        """Take in the Frames of one instant; the belief of each of their robots.

        That of a robot whose place in the map is not known yet is NaN.
        """
        for frame in frames:
            motion = self._wheels[frame.robot].predict(frame)
            self._motions[frame.robot] = self._motions[frame.robot].then(motion)
        extras: list[dict[str, Any]] = [{} for _ in frames]
        for frame, found in zip(frames, extras, strict=True):
            seen = frame.readings.get(self.stereo)
            image = None if seen is None else self.front_end.read(seen)
            if not self._is_placed[frame.robot]:
                self._place(frame, image, frames)
            if image is not None and self._is_placed[frame.robot]:
                self._move(frame.robot)
                found |= self._see(frame.robot, image)
        for frame in frames:
            if self._sightings is not None and self._is_placed[frame.robot]:
                self._sight(self._sightings, frame, frames)
        return [self._belief(*each) for each in zip(frames, extras, strict=True)]

    def _belief(self, frame: Frame, extras: dict[str, Any]) -> Belief:
        if not self._is_placed[frame.robot]:
            return Belief(np.full(3, np.nan), np.full((3, 3), np.nan), extras)
        own = _own(frame.robot)
        pose = Gaussian(self._mean[own], self._covariance[own, own])
        pose = pose.then(self._motions[frame.robot])
        if self.keep_map:
            extras |= {k: v for k, v in self.map.items() if k.startswith("landmark")}
        return Belief(pose.mean.copy(), (pose.covariance + pose.covariance.T) / 2.0, extras)

    @property
    def map(self) -> dict[str, Array | Ints]:
        """`landmarks` (N, 3) and `landmark_covariances` (N, 3, 3), m in map.

        `origins` (N,) are the observations, counted over the run, that started them; `ids` (N,)
        are the sensor's, if it gives any.
        """
        n, P, first = self._n_landmarks, self._covariance, 3 * self._n_robots
        blocks = P[first:, first:].reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n)]
        means = self._landmarks.copy()
        return self.front_end.map(means, blocks.reshape(n, 3, 3), slice(n))

    @property
    def _n_robots(self) -> int:
        return len(self._motions)

    @property
    def _n_landmarks(self) -> int:
        return len(self._mean) // 3 - self._n_robots

    @property
    def _landmarks(self) -> Array:
        return self._mean[3 * self._n_robots :].reshape(-1, 3)

    @property
    def _covariance(self) -> Array:
        """The part of the allotted room that is in use."""
        n = len(self._mean)
        return self._room[:n, :n]

    def _move(self, robot: int) -> None:
        """Apply a robot's motion since its last image to its pose and to its correlations."""
        P, own, motion = self._covariance, _own(robot), self._motions[robot]
        mean, by_pose, by_motion = compose(self._mean[own], motion.mean)
        noise = by_motion @ motion.covariance @ by_motion.T
        moved = by_pose @ P[own, own] @ by_pose.T + (noise + noise.T) / 2.0
        P[own] = by_pose @ P[own]
        P[:, own] = P[own].T
        P[own, own] = moved
        self._mean[own] = mean
        self._motions[robot] = STILL

    def _see(self, robot: int, image: Image) -> dict[str, Any]:
        """Take in one image; the extras that it gives."""
        extras: dict[str, Any] = {"status": image.status} if image.status else {}
        if len(image.points) > _MOST_OBSERVATIONS:
            image = image.of(np.arange(len(image.points)) < _MOST_OBSERVATIONS)
            extras["status"] = f"observations beyond {_MOST_OBSERVATIONS} rejected"
        slots = (
            self.front_end.known(image)
            if self.front_end.association == "known"
            else self._associate(robot, image.points, self.front_end.unlikeness(image))
        )
        old = slots >= 0
        fits = old | (np.cumsum(~old) <= _MOST_LANDMARKS - self._n_landmarks)
        if not fits.all():
            image, slots, old = image.of(fits), slots[fits], old[fits]
            extras["status"] = f"map full: landmarks beyond {_MOST_LANDMARKS} rejected"
        if old.any() and not self._update(robot, slots[old], image.points[old]):
            extras["status"] = "update rejected: broken covariance, not positive definite"
        if not old.all():
            self._create(robot, image.points[~old])
            self.front_end.start(image, ~old)
        extras["associations"] = self.front_end.associations(image, slots)
        return extras

    def _associate(self, robot: int, points: Array, unlikeness: Array) -> Ints:
        """Slot (K,) of each point, -1 for new ones; a landmark at most once an image."""
        slots = np.full(len(points), -1)
        if len(points) == 0 or self._n_landmarks == 0:
            return slots
        predicted = self._camera.predict(self._mean[_own(robot)], self._landmarks)[0]
        near = predicted[:, 2] > LEAST_DEPTH_M
        candidates = np.flatnonzero(
            near & (np.linalg.norm(predicted, axis=1) < self.front_end.reach_m)
        )
        if len(candidates) == 0:
            return slots
        _, *by = self._camera.predict(self._mean[_own(robot)], self._landmarks[candidates])
        spread = self._predicted_spread(_own(robot), self._rows(candidates), *by)
        distances = _distances(
            spread, *self._camera.innovation(predicted[None, candidates], points[:, None])
        )
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

    def _rows(self, slots: Ints) -> Ints:
        """Rows (K, 3) of landmarks in the state."""
        return 3 * (self._n_robots + slots[:, None]) + np.arange(3)

    def _predicted_spread(self, own: slice, at: Ints, of_pose: Array, of_landmark: Array) -> Array:
        """H P H^T (n, 3, 3) of each of n observations apart; arguments as in `_correct`."""
        P = self._covariance
        cross = P[own][:, at].transpose(1, 0, 2)
        theirs = P[at[:, :, None], at[:, None, :]]
        turned = of_landmark.transpose(0, 2, 1)
        mixed = of_pose @ cross @ turned
        spread: Array = (
            of_pose @ P[own, own] @ of_pose.transpose(0, 2, 1) + of_landmark @ theirs @ turned
        )
        return spread + mixed + mixed.transpose(0, 2, 1)

    def _update(self, robot: int, slots: Ints, points: Array) -> bool:
        """Kalman update by points (K, 3) of landmarks in these slots, all at once.

        Rejected, with False, if rounding has left the innovation without a proper covariance.
        """
        own = _own(robot)
        predicted, of_pose, of_landmark = self._camera.predict(
            self._mean[own], self._landmarks[slots]
        )
        v, R = self._camera.innovation(predicted, points)
        return self._correct(own, self._rows(slots), of_pose, of_landmark, v, R)

    def _correct(
        self, own: slice, at: Ints, of_pose: Array, of_landmark: Array, v: Array, R: Array
    ) -> bool:
        """Kalman update by K innovations v (K, 3) with noise R (K, 3, 3).

        Parameters
        ----------
        own, at
            Rows of the observing robot's pose, and (K, 3) of what it observes.
        of_pose, of_landmark
            (K, 3, 3) derivatives of the predicted points by these.
        """
        P, K, n = self._covariance, len(at), 3 * len(at)
        rows = P[at].reshape(K, 3, -1)
        HP = (of_pose @ P[own] + of_landmark @ rows).reshape(n, -1)  # H has two blocks a row
        along = HP[:, at].reshape(n, K, 3).transpose(1, 0, 2)
        S = HP[:, own] @ of_pose.reshape(n, 3).T
        S += (along @ of_landmark.transpose(0, 2, 1)).transpose(1, 0, 2).reshape(n, n)
        for k in range(K):
            S[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += R[k]
        try:
            factor = cho_factor((S + S.T) / 2.0, lower=True)
        except np.linalg.LinAlgError:
            return False
        self._mean += HP.T @ cho_solve(factor, v.ravel())
        for row in range(2, 3 * self._n_robots, 3):
            self._mean[row] = wrap(float(self._mean[row]))
        half = solve_triangular(factor[0], HP, lower=True)
        P -= half.T @ half  # symmetric to the last bit
        return True

    def _create(self, robot: int, points: Array) -> None:
        """Append landmarks at points (K, 3), gil2008, eqs. (16)-(18), with their correlations."""
        own, before, n = _own(robot), len(self._mean), 3 * len(points)
        pose = self._mean[own]
        placed = self._camera.place(np.tile(pose, (len(points), 1)), points)
        predicted, of_pose, of_landmark = self._camera.predict(pose, placed)
        # p = C (l - t(pose)) and so l = t(pose) + C^T p
        C_T = of_landmark.transpose(0, 2, 1)
        by_pose = -(C_T @ of_pose).reshape(n, 3)
        R = self._camera.innovation(predicted, points)[1]
        after = before + n
        if after > len(self._room):
            wanted = min(after + after // 2, 3 * (self._n_robots + _MOST_LANDMARKS))
            self._room = np.pad(self._covariance, (0, wanted - before))
        P = self._room[:after, :after]
        P[before:, :before] = by_pose @ P[own, :before]
        P[:before, before:] = P[before:, :before].T
        fresh = by_pose @ P[own, own] @ by_pose.T
        for k, block in enumerate(C_T @ R @ of_landmark):
            fresh[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += block
        P[before:, before:] = (fresh + fresh.T) / 2.0
        self._mean = np.concatenate([self._mean, placed.ravel()])

    def _sight(self, sightings: Sightings, frame: Frame, frames: Sequence[Frame]) -> None:
        """Update by a robot's sightings of others that have a Frame at this instant too."""
        known = [f.robot for f in frames if self._is_placed[f.robot] and f.robot != frame.robot]
        others = np.array(known, np.int64)
        points, numbers = sightings.read(frame)
        if len(points) == 0 or len(others) == 0:
            return
        for robot in (frame.robot, *known):
            self._move(robot)
        own, at = _own(frame.robot), 3 * others[:, None] + np.arange(3)
        predicted, of_pose, of_other = sightings.predict(self._mean[own], self._mean[at])
        spread = self._predicted_spread(own, at, of_pose, of_other)
        innovations = sightings.camera.innovation(predicted[None], points[:, None])
        distances = _distances(spread, *innovations)
        distances[:, predicted[:, 2] < LEAST_DEPTH_M] = np.inf
        if numbers is not None:
            distances[numbers[:, None] != others] = np.inf
        rows, columns = _matches(distances, self.sighting_d0)
        if len(rows):
            v, R = sightings.camera.innovation(predicted[columns], points[rows])
            self._correct(own, at[columns], of_pose[columns], of_other[columns], v, R)

    def _place(self, frame: Frame, image: Image | None, frames: Sequence[Frame]) -> None:
        """Give a robot of unknown start its place, if this instant shows it."""
        in_base, in_map = [np.zeros((0, 2))], [np.zeros((0, 2))]
        slots, points = np.zeros(0, np.int64), np.zeros((0, 3))
        if image is not None:
            slots = self.front_end.known(image)
            slots, points = slots[slots >= 0], image.points[slots >= 0]
            in_base.append(self._camera.place(np.zeros(3), points)[..., :2])
            in_map.append(self._landmarks[slots, :2])
        poses = {f.robot: self._pose_now(f.robot) for f in frames if self._is_placed[f.robot]}
        if self._sightings is not None:
            for seen in self._sightings.of_robot(frame, frames, poses):
                in_base.append(seen[0])
                in_map.append(seen[1])
        pose = pose_by_points(np.concatenate(in_base), np.concatenate(in_map))
        if pose is not None:
            own = _own(frame.robot)
            if len(slots) >= 2:
                pose = self._refined(pose, slots, points)
            self._mean[own], self._covariance[own, own] = pose, _ENTERS
            self._motions[frame.robot] = STILL
            self._is_placed[frame.robot] = True

    def _refined(self, pose: Array, slots: Ints, points: Array) -> Array:
        """Pose that fits points (K, 3) of landmarks best, about which the update linearises."""
        at = self._rows(slots)
        spread = self._covariance[at[:, :, None], at[:, None, :]]
        for _ in range(_REFINEMENTS):
            predicted, H, of_landmark = self._camera.predict(pose, self._landmarks[slots])
            v, R = self._camera.innovation(predicted, points)
            weighted = np.linalg.solve(of_landmark @ spread @ of_landmark.transpose(0, 2, 1) + R, H)
            information = np.einsum("kji,kjl->il", weighted, H)
            pose = pose + np.linalg.solve(information, np.einsum("kji,kj->i", weighted, v))
        return pose

    def _pose_now(self, robot: int) -> Array:
        return compose(self._mean[_own(robot)], self._motions[robot].mean)[0]


def _own(robot: int) -> slice:
    """Rows of a robot's pose in the state."""
    return slice(3 * robot, 3 * robot + 3)


def _distances(spread: Array, v: Array, R: Array) -> Array:
    """Squared Mahalanobis distances (K, n) of innovations v (K, n, 3); R may be common to all K."""
    S = spread + R
    return np.asarray(np.sum(v * np.linalg.solve(S, v[..., None])[..., 0], axis=-1))


def _matches(distances: Array, d0: float) -> tuple[Ints, Ints]:
    """Rows and columns of the least distances below d0, each row and column once."""
    left, rows, columns = distances.copy(), [], []
    while left.size and left.min() < d0:
        row, column = np.unravel_index(int(np.argmin(left)), left.shape)
        rows.append(row)
        columns.append(column)
        left[row], left[:, column] = np.inf, np.inf
    return np.array(rows, np.int64), np.array(columns, np.int64)
