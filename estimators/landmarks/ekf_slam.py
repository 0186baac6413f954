"""EKF-SLAM with stereo landmarks, the classical comparison of gil2008 (its refs. 8, 24 to 26).

One Gaussian over the robot's pose and all landmarks, with all their correlations; so there is one
association for the whole filter, and a wrong one is never taken back. Of a team it holds the poses
of all robots, and one map.
"""

import math
from collections.abc import Sequence
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from estimators.base import Belief, Prior, TeamEstimator
from estimators.gaussian import STILL, Gaussian, compose, wrap
from estimators.landmarks.doubt import Doubt
from estimators.landmarks.joint import JointGaussian, mahalanobis_squared, quarter_turned
from estimators.landmarks.sightings import (
    Sightings,
    dead_reckoning,
    pair_nearest,
    pose_by_points,
    team_starts,
)
from estimators.landmarks.slam_frontend import Image, LandmarkSlamOptions, SlamFrontEnd
from estimators.landmarks.stereo import MIN_DEPTH_M
from estimators.lost import Unexplained
from estimators.wheels import NO_MOTION, GainOptions, gained_motion
from sim.arrays import Array, Ints
from sim.errors import require
from sim.options import options
from sim.recording import Frame

Errors = Literal["coordinates", "invariant"]

# One covariance holds the correlations of all landmarks: 1.2 GB of it
_MOST_LANDMARKS, _MOST_OBSERVATIONS = 4000, 1000
# Covariance of a robot that enters the map: wide, against what is measured then
_ENTERS = np.diag(np.square([10.0, 10.0, 1.0]))
_FORGOTTEN_M = 10.0  # deviation of a landmark that a lost robot has placed
_REFINEMENTS = 5


@options("estimator")
class EkfSlamOptions(LandmarkSlamOptions, GainOptions):
    """Options of EKF-SLAM."""

    doubt_sightings: Annotated[int, Field(ge=0, le=30)] = 10
    """With a gate: after so many sightings of known landmarks, four fifths of them rejected, the
    pose on which those agree replaces the filter's, which a turn unseen by the wheels locks out."""
    errors: Errors = "invariant"
    """What an update corrects. `coordinates`: headings and positions, as the classical filter does.
    `invariant`: the turn and shift of all that a robot has placed, itself too, about the origin of
    the map frame, and what is left of each position: x = R(e_turn) x_hat + e_x, where e_turn is the
    error of the robot's heading. What it sees does not change with the turn, so no update can make
    the heading of the whole map look known, which linearising at ever other estimates does (Barrau
    and Bonnabel, "An EKF-SLAM algorithm with consistency properties", 2015)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            not self.gain_wander_m or self.gain_sigma,
            "estimator.gain_wander_m has no effect on known gains; set estimator.gain_sigma",
        )


class EkfSlam(EkfSlamOptions, TeamEstimator):
    """Extended Kalman filter over pose and landmarks.

    At an image the motion since the last one is applied, the landmarks seen are associated, all of
    them update the state at once, and those not in the map enter it with their correlations.

    Of a team, a sighting updates the poses of both robots. One of unknown start enters the map at
    the first instant that shows two points of it a metre apart: landmarks, robots that it sees, or
    itself as another sees it.

    Notes
    -----
    Extras: `associations` (K,): for each observation, counted from 0 over the whole run, the one
    that started its landmark, itself if it is the first, -1 if it was rejected, -2 if its landmark
    has just counted (`repeat_s`); with `keep_map` also `landmarks` (N, 3) and
    `landmark_covariances` (N, 3, 3); `wheel_gains` (3,), g_r, g_l and g_b, where they are states;
    `status` when an image was not used; with each image `lost`, from 0 to 1, by known ids.

    A step costs O(K N^2): the whole covariance is touched. So the map holds at most 4000 landmarks;
    `status` says when it is full, and when an image has more than 1000 observations.
    """

    needs = frozenset({"stereo"})

    def reset_team(self, priors: Sequence[Prior], rng: np.random.Generator) -> None:
        """Start a team from the priors of its robots; that of robot 0 has a pose.

        Raises
        ------
        InputError
            If the robots do not carry the same sensors, or a start is unknown and the camera does
            not identify landmarks.
        """
        n = len(priors)
        require(
            n == 1 or not self.gain_sigma,
            "ekf_slam: gains of wheels hold for one robot; set estimator.gain_sigma=0",
        )
        self.front_end = SlamFrontEnd(self, priors[0], "ekf_slam")
        starts = team_starts(priors, self.front_end, "ekf_slam")
        noise = self.noise_model, self.noise_at
        self._sightings = Sightings.of(priors, self.robots, "ekf_slam", *noise)
        self._camera, self._wheels = self.front_end.camera, dead_reckoning(self, priors)
        self._is_placed = [start is not None for start in starts]
        self._gains = slice(3 * n, 3 * n + 3) if self.gain_sigma else None
        self._first_landmark = first = 3 * n + (3 if self._gains else 0)
        mean, P = np.zeros(first), np.zeros((first, first))
        if self._gains:
            P[self._gains, self._gains] = self.gain_sigma**2 * np.eye(3)
            self._gained, self._nominal_track_m = NO_MOTION, priors[0].robot.track_m
        for robot, start in enumerate(starts):
            if start is not None:
                mean[_own(robot)], P[_own(robot), _own(robot)] = start.mean, start.covariance
        self._state = JointGaussian(mean, P, first + 3 * _MOST_LANDMARKS)
        self._motions = [STILL] * n  # since the last image
        self._unexplained = [Unexplained() for _ in range(n)]
        after = 0 if self.gate_probability is None else self.doubt_sightings
        self._doubts = [Doubt(after) for _ in range(n)]
        self._placed_by = np.zeros(0, np.int64)  # robot that has added each landmark
        self._n_trusted = [0] * n  # landmarks when a robot's last sighting of one passed the gate

    def step_team(self, frames: Sequence[Frame]) -> list[Belief]:
        """Take in the Frames of one instant; the belief of each of their robots.

        That of a robot whose place in the map is not known yet is NaN.
        """
        self._now_s = frames[0].stamp
        for frame in frames:
            self._roll(frame)
        extras: list[dict[str, Any]] = [{} for _ in frames]
        for frame, own in zip(frames, extras, strict=True):
            image = self.front_end.read(frame) if self.stereo in frame.readings else None
            if not self._is_placed[frame.robot]:
                self._place(frame, image, frames)
            if image is not None and self._is_placed[frame.robot]:
                self._move(frame.robot)
                own |= self._see(frame, image)
        for frame in frames:
            if self._sightings is not None and self._is_placed[frame.robot]:
                self._sight(self._sightings, frame, frames)
        return [self._belief(*each) for each in zip(frames, extras, strict=True)]

    def _roll(self, frame: Frame) -> None:
        """Add a Frame to a robot's motion since its last image."""
        robot, wheels = frame.robot, self._wheels[frame.robot]
        if self._gains:
            by_gains = gained_motion(
                wheels, frame, self._state.mean[self._gains], self._nominal_track_m
            )
            self._gained = self._gained.then(by_gains)
        else:
            self._motions[robot] = self._motions[robot].then(wheels.predict(frame))

    def _belief(self, frame: Frame, extras: dict[str, Any]) -> Belief:
        if not self._is_placed[frame.robot]:
            return Belief(np.full(3, np.nan), np.full((3, 3), np.nan), extras)
        own = _own(frame.robot)
        pose = Gaussian(self._state.mean[own], self._state.covariance[own, own])
        if self._gains:
            both = slice(own.start, self._gains.stop)  # of one robot: its pose and the gains
            P = self._state.covariance[both, both].copy()
            mean = self._gained.apply(pose.mean, P, slice(0, 3), slice(3, 6))
            pose = Gaussian(mean, P[:3, :3])
            extras["wheel_gains"] = self._state.mean[self._gains].copy()
        else:
            pose = pose.then(self._motions[frame.robot])
        if "associations" in extras and self.front_end.identified:
            extras["lost"] = self._unexplained[frame.robot].lost(frame.stamp, pose.covariance)
        if self.keep_map:
            extras |= {k: v for k, v in self.map.items() if k.startswith("landmark")}
        return Belief(pose.mean.copy(), (pose.covariance + pose.covariance.T) / 2.0, extras)

    @property
    def map(self) -> dict[str, Array | Ints]:
        """`landmarks` (N, 3) and `landmark_covariances` (N, 3, 3), m in map.

        `origins` (N,) are the observations, counted over the run, that started them; `ids` (N,)
        are the sensor's, if it gives any.
        """
        n, P, first = self._n_landmarks, self._state.covariance, self._first_landmark
        every = np.arange(n)
        blocks = P[first:, first:].reshape(n, 3, n, 3)[every, :, every].reshape(n, 3, 3)
        return self.front_end.map(self._landmarks.copy(), blocks, slice(n))

    @property
    def _n_landmarks(self) -> int:
        return (len(self._state.mean) - self._first_landmark) // 3

    @property
    def _landmarks(self) -> Array:
        return self._state.mean[self._first_landmark :].reshape(-1, 3)

    def _move(self, robot: int) -> None:
        """Apply a robot's motion since its last image to its pose and to its correlations."""
        P, own, motion = self._state.covariance, _own(robot), self._motions[robot]
        self._doubts[robot].move((self._gained.motion if self._gains else motion).mean)
        if self._gains:
            walked = self.gain_wander_m * self._gained.travel_m
            self._state.mean[own] = self._gained.apply(self._state.mean[own], P, own, self._gains)
            P[self._gains, self._gains] += walked * np.eye(3)
            self._gained = NO_MOTION
            return
        mean, by_pose, by_motion = compose(self._state.mean[own], motion.mean)
        noise = by_motion @ motion.covariance @ by_motion.T
        self._state.mean[own], self._motions[robot] = mean, STILL
        moved = by_pose @ P[own, own] @ by_pose.T + (noise + noise.T) / 2.0
        P[own] = by_pose @ P[own]
        P[:, own] = P[own].T
        P[own, own] = moved

    def _see(self, frame: Frame, image: Image) -> dict[str, Any]:
        """Take in one image; the extras that it gives."""
        robot = frame.robot
        extras: dict[str, Any] = {"status": image.status} if image.status else {}
        if len(image.points) > _MOST_OBSERVATIONS:
            image = image.select(np.arange(len(image.points)) < _MOST_OBSERVATIONS)
            extras["status"] = f"observations beyond {_MOST_OBSERVATIONS} rejected"
        slots = (
            self.front_end.known(image)
            if self.front_end.identified
            else self._associate(robot, image.points, self.front_end.unlikeness(image))
        )
        if self.gate_probability is not None and len(slots):
            passed = self._passed(robot, image, slots)
            if self._relocate(robot):
                passed = self._passed(robot, image, slots) & (slots >= 0)
                extras["status"] = "gate locked out: placed again by its last sightings"
            image, slots = image.select(passed), slots[passed]
        self.front_end.note_counted(image, frame)
        old = slots >= 0
        fits = old | (np.cumsum(~old) <= _MOST_LANDMARKS - self._n_landmarks)
        if not fits.all():
            image, slots, old = image.select(fits), slots[fits], old[fits]
            extras["status"] = f"map full: landmarks beyond {_MOST_LANDMARKS} rejected"
        if old.any() and not self._revisit(robot, slots[old], image.points[old]):
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
        predicted = self._camera.predict(self._state.mean[_own(robot)], self._landmarks)[0]
        near = np.linalg.norm(predicted, axis=1) < self.front_end.reach_m
        candidates = np.flatnonzero((predicted[:, 2] > MIN_DEPTH_M) & near)
        if len(candidates) == 0:
            return slots
        _, *by = self._predict(robot, self._landmarks[candidates])
        spread = self._predicted_spread(_own(robot), self._rows(candidates), *by)
        v, R = self._camera.innovation(predicted[None, candidates], points[:, None])
        distances = mahalanobis_squared(v, spread + R)
        scores = np.where(distances < self.d0, distances, np.inf)
        if unlikeness.shape[1] > 0:
            unlike = unlikeness[:, candidates]
            scores = np.where(unlike > 0.0, np.inf, scores + unlike)
        for k, score in enumerate(scores):
            best = int(np.argmin(score))
            if math.isfinite(score[best]):
                slots[k] = candidates[best]
                scores[:, best] = np.inf
        return slots

    def _passed(self, robot: int, image: Image, slots: Ints) -> NDArray[np.bool_]:
        """Which observations (K,) of landmarks in these slots, -1 for new ones, pass the gate."""
        own, old = _own(robot), slots[slots >= 0]
        predicted, *by = self._predict(robot, self._landmarks[old])
        v, R = self._camera.innovation(predicted, image.points[slots >= 0])
        distances = mahalanobis_squared(v, self._predicted_spread(own, self._rows(old), *by) + R)
        passed = self.front_end.passed(image, slots, distances, self._state.mean[own])
        doubt, known = self._doubts[robot], slots >= 0
        if known.any():
            in_base = self._camera.place(np.zeros(3), image.points[known])[..., :2]
            doubt.note(old, in_base, passed[known])
        n_rejected = int((~passed[known]).sum())  # those that pass are counted by the update
        self._unexplained[robot].note(self._now_s, n_rejected, n_rejected)
        if passed[known].any():
            self._n_trusted[robot] = self._n_landmarks
        return passed & (known | (not doubt.rises))

    def _relocate(self, robot: int) -> bool:
        """Where the gate has locked a robot out, put it where its sightings agree that it is.

        What it knew of its pose is forgotten, and so is the place of each landmark that it has
        added since the last sighting that passed.
        """
        pose = self._doubts[robot].resolve(self._landmarks[:, :2])
        if pose is None:
            return False
        P, own = self._state.covariance, _own(robot)
        P[own], P[:, own] = 0.0, 0.0
        P[own, own], self._state.mean[own] = _ENTERS, pose
        for rows in self._rows(np.arange(self._n_trusted[robot], self._n_landmarks)):
            P[rows, rows] += _FORGOTTEN_M**2
        self._doubts[robot].clear()
        return True

    def _rows(self, slots: Ints) -> Ints:
        """Rows (K, 3) of landmarks in the state."""
        return self._first_landmark + 3 * slots[:, None] + np.arange(3)

    def _predicted_spread(self, own: slice, at: Ints, of_pose: Array, of_other: Array) -> Array:
        """H P H^T (n, 3, 3) of each of n observations apart; arguments as in `_update`."""
        P = self._state.covariance
        cross = P[own][:, at].transpose(1, 0, 2)
        theirs = P[at[:, :, None], at[:, None, :]]
        turned = of_other.transpose(0, 2, 1)
        mixed = of_pose @ cross @ turned
        spread: Array = (
            of_pose @ P[own, own] @ of_pose.transpose(0, 2, 1) + of_other @ theirs @ turned
        )
        return spread + mixed + mixed.transpose(0, 2, 1)

    def _revisit(self, robot: int, slots: Ints, points: Array) -> bool:
        """Update by points (K, 3) of landmarks in these slots, as `_update` does."""
        predicted, of_pose, of_landmark = self._predict(robot, self._landmarks[slots])
        v, R = self._camera.innovation(predicted, points)
        return self._update(_own(robot), self._rows(slots), of_pose, of_landmark, v, R)

    def _update(
        self, own: slice, at: Ints, of_pose: Array, of_other: Array, v: Array, R: Array
    ) -> bool:
        """Kalman update by K innovations v (K, 3) with noise R (K, 3, 3), all at once.

        Rejected, with False, if rounding has left the innovation without a proper covariance.

        Parameters
        ----------
        own, at
            Rows of the observing robot's pose, and (K, 3) of what it observes.
        of_pose, of_other
            (K, 3, 3) derivatives of the predicted points by these.
        """
        HP, S, by_other = self._state.predicted(own, at, of_pose, of_other)
        S += by_other
        for k in range(len(at)):
            S[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += R[k]
        if self.front_end.identified:  # else those that are far count as new
            own_S = S.reshape(len(at), 3, len(at), 3)[every := np.arange(len(at)), :, every]
            far = mahalanobis_squared(v, own_S) > self.d0
            self._unexplained[own.start // 3].note(self._now_s, int(far.sum()), len(at))
        correction = self._state.update(HP, S, v)
        if correction is not None:
            self._correct(correction)
        return correction is not None

    def _correct(self, by: Array) -> None:
        """Correct the mean by (n,) errors of its coordinates: added, or motions of maps.

        The covariance stays that of coordinates. What an error of a heading does to a position
        depends on where that is, and so it changes with the correction.
        """
        mean, P, n_robots = self._state.mean, self._state.covariance, len(self._motions)
        headings = np.arange(2, 3 * n_robots, 3)
        if self.errors == "invariant":
            is_place = np.ones(len(mean) // 3, bool)
            is_place[n_robots : self._first_landmark // 3] = False  # gains
            of = np.concatenate([np.arange(n_robots), self._placed_by])
            before, turn = mean.reshape(-1, 3)[is_place, :2], by[headings[of]][:, None]
            shift = by.reshape(-1, 3)[is_place, :2] - turn * quarter_turned(before)
            moved = _turned(before, turn) + _carried(shift, turn) - before
            by = by.copy()
            by.reshape(-1, 3)[is_place, :2] = moved
            arms = np.zeros((len(is_place), 3, n_robots))
            arms[np.flatnonzero(is_place), :2, of] = quarter_turned(moved)
            D = arms.reshape(-1, n_robots)
            change = D @ (P[headings] + 0.5 * P[np.ix_(headings, headings)] @ D.T)
            P += change + change.T
        mean += by
        for row in headings:
            mean[row] = wrap(float(mean[row]))

    def _predict(self, robot: int, landmarks: Array) -> tuple[Array, Array, Array]:
        """Predicted points of landmarks (K, 3) and their derivatives by pose and landmark."""
        return self._camera.predict(self._state.mean[_own(robot)], landmarks)

    def _create(self, robot: int, points: Array) -> None:
        """Append landmarks at points (K, 3), gil2008, eqs. (16)-(18), with their correlations."""
        own = _own(robot)
        placed = self._camera.place(np.tile(self._state.mean[own], (len(points), 1)), points)
        predicted, of_pose, of_landmark = self._predict(robot, placed)
        # p = C (l - t(pose)) and so l = t(pose) + C^T p
        C_T = of_landmark.transpose(0, 2, 1)
        R = self._camera.innovation(predicted, points)[1]
        self._state.extend(own, -(C_T @ of_pose), placed, C_T @ R @ of_landmark)
        self._placed_by = np.append(self._placed_by, np.full(len(points), robot))

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
        predicted, of_pose, of_other = sightings.predict(
            self._state.mean[own], self._state.mean[at]
        )
        spread = self._predicted_spread(own, at, of_pose, of_other)
        v, R = sightings.camera.innovation(predicted[None], points[:, None])
        distances = mahalanobis_squared(v, spread + R)
        distances[:, predicted[:, 2] < MIN_DEPTH_M] = np.inf
        if numbers is not None:
            distances[numbers[:, None] != others] = np.inf
        rows, columns = pair_nearest(distances, self.sighting_d0)
        if len(rows):
            v, R = sightings.camera.innovation(predicted[columns], points[rows])
            self._update(own, at[columns], of_pose[columns], of_other[columns], v, R)

    def _place(self, frame: Frame, image: Image | None, frames: Sequence[Frame]) -> None:
        """Give a robot of unknown start its place, if this instant shows it."""
        in_base, in_map = [np.zeros((0, 2))], [np.zeros((0, 2))]
        slots, points = np.zeros(0, np.int64), np.zeros((0, 3))
        if image is not None:
            slots = self.front_end.known(image)
            slots, points = slots[slots >= 0], image.points[slots >= 0]
            in_base.append(self._camera.place(np.zeros(3), points)[..., :2])
            in_map.append(self._landmarks[slots, :2])
        poses = {
            f.robot: compose(self._state.mean[_own(f.robot)], self._motions[f.robot].mean)[0]
            for f in frames
            if self._is_placed[f.robot]
        }
        if self._sightings is not None:
            for seen in self._sightings.of_robot(frame, frames, poses):
                in_base.append(seen[0])
                in_map.append(seen[1])
        pose = pose_by_points(np.concatenate(in_base), np.concatenate(in_map))
        if pose is not None:
            own = _own(frame.robot)
            if len(slots) >= 2:
                pose = self._refined(pose, slots, points)
            self._state.mean[own], self._state.covariance[own, own] = pose, _ENTERS
            self._motions[frame.robot] = STILL
            self._is_placed[frame.robot] = True

    def _refined(self, pose: Array, slots: Ints, points: Array) -> Array:
        """Pose that fits points (K, 3) of landmarks best, about which the update linearises."""
        at = self._rows(slots)
        spread = self._state.covariance[at[:, :, None], at[:, None, :]]
        for _ in range(_REFINEMENTS):
            predicted, H, of_landmark = self._camera.predict(pose, self._landmarks[slots])
            v, R = self._camera.innovation(predicted, points)
            weighted = np.linalg.solve(of_landmark @ spread @ of_landmark.transpose(0, 2, 1) + R, H)
            information = np.einsum("kji,kjl->il", weighted, H)
            pose = pose + np.linalg.solve(information, np.einsum("kji,kj->i", weighted, v))
        return pose


def _own(robot: int) -> slice:
    """Rows of a robot's pose in the state."""
    return slice(3 * robot, 3 * robot + 3)


def _turned(points: Array, turn_rad: Array) -> Array:
    """R(a) x of points (n, 2) and turns (n, 1)."""
    turned: Array = np.cos(turn_rad) * points + np.sin(turn_rad) * quarter_turned(points)
    return turned


def _carried(shift: Array, turn_rad: Array) -> Array:
    """V(a) e of shifts (n, 2) at turns (n, 1), the shift of the exponential of both."""
    half = np.sinc(turn_rad / (2.0 * np.pi))
    carried: Array = half * _turned(shift, turn_rad / 2.0)
    return carried
