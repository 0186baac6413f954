"""Landmark SLAM by filterpy's extended Kalman filter, as its manual has one write a filter.

Labbe, Kalman and Bayesian Filters in Python (2014), ch. 11. The state is the robot's pose and the
landmarks' places in the plane; what is measured are places in base_link.
"""

import numpy as np

from estimators.base import Belief, Prior
from estimators.gaussian import compose
from estimators.graph.landmark_drive import read_observations
from estimators.landmarks.stereo import StereoModel, StereoOptions
from estimators.peers import package
from estimators.wheels import WheelOptions, WheelPrediction
from sim import se2
from sim.arrays import Array, Ints
from sim.options import options
from sim.recording import Frame


@options("estimator")
class FilterpyEkfOptions(WheelOptions, StereoOptions):
    """Options of filterpy's filter; the camera's landmarks must be identified."""

    def __post_init__(self) -> None:
        package("filterpy.kalman", "peers")


class FilterpyEkf(FilterpyEkfOptions):
    """Roll by the wheels; at an image, update, and put new landmarks into the state."""

    needs = frozenset({"stereo"})

    def reset(self, prior: Prior, rng: np.random.Generator) -> None:
        """Start from the prior's pose, with an empty map."""
        start = prior.require_start("filterpy_ekf")
        self._camera = StereoModel.of(prior.require_stereo(self.stereo, "filterpy_ekf"))
        self._wheels = WheelPrediction(self, prior.robot.track_m)
        self._ekf = package("filterpy.kalman", "peers").ExtendedKalmanFilter(dim_x=3, dim_z=2)
        self._ekf.x, self._ekf.P = start.mean.copy(), start.covariance.copy()
        self._places: dict[int, int] = {}  # where a landmark begins in the state

    def step(self, frame: Frame) -> Belief:
        """Belief after a Frame."""
        ekf, motion = self._ekf, self._wheels.predict(frame)
        pose, by_pose, by_motion = compose(ekf.x[:3], motion.mean)
        n = len(ekf.x)
        F, Q = np.eye(n), np.zeros((n, n))
        F[:3, :3], Q[:3, :3] = by_pose, by_motion @ motion.covariance @ by_motion.T
        ekf.F, ekf.Q = F, Q
        ekf.predict()
        ekf.x[:3] = pose  # which `predict` takes to be linear
        seen, status = read_observations(frame, self.stereo, self._camera, "filterpy_ekf")
        if seen is not None:
            self._see(*seen)
        extras = {"status": status} if status else {}
        return Belief(ekf.x[:3].copy(), ekf.P[:3, :3].copy(), extras)

    def _see(self, points_in_camera: Array, ids: Ints) -> None:
        """Correct the state by landmarks that it has, and add the others."""
        _, C = self._camera.axes(np.zeros(3))
        points = self._camera.place(np.zeros(3), points_in_camera)[:, :2]
        noise = (C.T @ self._camera.covariance(points_in_camera) @ C)[:, :2, :2]
        known = np.array([number in self._places for number in ids.tolist()])
        at = np.array([self._places[number] for number in ids[known].tolist()], np.int64)
        if len(at):
            R = np.zeros((2 * len(at), 2 * len(at)))
            for k, covariance in enumerate(noise[known]):
                R[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = covariance
            self._ekf.update(
                points[known].ravel(), _jacobian, _expected, R=R, args=(at,), hx_args=(at,)
            )
        for k in np.flatnonzero(~known).tolist():
            if int(ids[k]) not in self._places:
                self._add(int(ids[k]), points[k], noise[k])

    def _add(self, number: int, point: Array, noise: Array) -> None:
        """Put a landmark, seen at a point (2,) of base_link, into the state."""
        ekf, n = self._ekf, len(self._ekf.x)
        turn = _turn(ekf.x[2])
        place = se2.transform(ekf.x[:3], point[None])[0]
        arm = place - ekf.x[:2]
        G = np.eye(n + 2, n)
        G[n:, :2], G[n:, 2] = np.eye(2), (-arm[1], arm[0])
        P = G @ ekf.P @ G.T
        P[n:, n:] += turn @ noise @ turn.T
        ekf.x, ekf.P = np.append(ekf.x, place), P
        ekf.dim_x, ekf._I = n + 2, np.eye(n + 2)  # filterpy's own filters do not grow
        self._places[number] = n


def _turn(heading_rad: float) -> Array:
    cos, sin = np.cos(heading_rad), np.sin(heading_rad)
    return np.array([[cos, -sin], [sin, cos]])


def _expected(x: Array, at: Ints) -> Array:
    """Places (2 K,) in base_link of the landmarks that begin at these rows of the state."""
    return se2.transform(se2.inverse(x[:3]), x[at[:, None] + [0, 1]]).ravel()


def _jacobian(x: Array, at: Ints) -> Array:
    """Their derivative (2 K, N) by the state."""
    H, back = np.zeros((2 * len(at), len(x))), _turn(x[2]).T
    for k, row in enumerate(at.tolist()):
        arm = x[row : row + 2] - x[:2]
        H[2 * k : 2 * k + 2, :2] = -back
        H[2 * k : 2 * k + 2, 2] = back @ (arm[1], -arm[0])
        H[2 * k : 2 * k + 2, row : row + 2] = back
    return H
