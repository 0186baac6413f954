"""The measurement model of `smoother` as factors of GTSAM, for both of its solvers.

A planar pose is a Pose3 held to the plane, because GTSAM's stereo factor takes one. Noise has the
covariances of `StereoModel` (column, row and disparity) and of the wheels.
"""

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from estimators.base import Belief, Prior
from estimators.gaussian import STILL, Gaussian, rotate
from estimators.graph.landmark_drive import FLOOR, loosen, read_observations
from estimators.landmarks.stereo import StereoModel, StereoOptions
from estimators.peers import matrix_of, package
from estimators.wheels import WheelOptions, WheelPrediction
from sim import se2
from sim.arrays import Array, Ints
from sim.errors import require
from sim.options import Count, Positive, options
from sim.recording import Frame

_FLAT_SIGMA = 1e-5  # height m, roll and pitch rad, of every pose
_FREE_SIGMA = 1e3
_IN_PLANE = [3, 4, 2]  # x, y, yaw of a Pose3's tangent: roll, pitch, yaw, x, y, z
_OUT_OF_PLANE = [0, 1, 5]


@options("estimator")
class GtsamOptions(WheelOptions, StereoOptions):
    """Options of both of GTSAM's solvers; the camera's landmarks must be identified."""

    def __post_init__(self) -> None:
        package("gtsam", "gtsam")


@options("estimator")
class Isam2Options(GtsamOptions):
    """GTSAM's own options of iSAM2, with its defaults."""

    relinearize_threshold: Positive = 0.1
    """How far a variable moves before it is linearised again."""
    relinearize_skip: Count = 10
    """At how many updates that is looked at."""
    updates: Count = 1
    """Calls of `update` at every image."""
    factorization: Literal["cholesky", "qr"] = "cholesky"
    """How linear systems are solved. `qr` is slower, and holds where `cholesky` ends the run since
    some noise is far smaller than the rest, as that of wheels that have not turned yet."""


class GtsamModel:
    """Makes factors of poses 'x' 0, 1, ... and landmarks 'l' by id.

    Raises
    ------
    InputError
        If the camera's noise is not Gaussian in the image, as that of GTSAM's factor is.
    """

    def __init__(self, camera: StereoModel) -> None:
        require(
            camera.in_image,
            "gtsam measures landmarks in the image; set sensors.stereo.correlated=true",
        )
        self._gtsam = package("gtsam", "gtsam")
        g = self._gtsam
        self._camera = camera
        self._calibration = g.Cal3_S2Stereo(
            camera.focal_px, camera.focal_px, 0.0, 0.0, 0.0, camera.baseline_m
        )
        position, C = camera.axes(np.zeros(3))
        self._mount = g.Pose3(g.Rot3(C.T), position)
        # left column c, right column c - d, row: c, r and d err independently
        by_image = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
        covariance = by_image @ np.diag(camera.variances_px2) @ by_image.T
        self._stereo_noise = g.noiseModel.Gaussian.Covariance(covariance)
        sigmas = np.full(6, _FREE_SIGMA)
        sigmas[_OUT_OF_PLANE] = _FLAT_SIGMA
        self._flat_noise = g.noiseModel.Diagonal.Sigmas(sigmas)
        self._by_image = by_image

    def pose_key(self, pose: int) -> int:
        """Key of a pose by its number."""
        return int(self._gtsam.symbol("x", pose))

    def landmark_key(self, landmark: int) -> int:
        """Key of a landmark by its id."""
        return int(self._gtsam.symbol("l", landmark))

    def graph_and_values(self) -> tuple[Any, Any]:
        """Empty graph and values."""
        return self._gtsam.NonlinearFactorGraph(), self._gtsam.Values()

    def pose3(self, pose: Array) -> Any:
        """Pose3 of a planar pose (3,)."""
        return self._gtsam.Pose3(matrix_of(pose))

    def add_start(self, graph: Any, start: Gaussian) -> None:
        """Add what is known of pose 0."""
        noise = self._noise(start)
        graph.add(self._gtsam.PriorFactorPose3(self.pose_key(0), self.pose3(start.mean), noise))

    def add_motion(self, graph: Any, first: int, second: int, motion: Gaussian) -> None:
        """Add the motion T_first_second."""
        keys = self.pose_key(first), self.pose_key(second)
        graph.add(
            self._gtsam.BetweenFactorPose3(*keys, self.pose3(motion.mean), self._noise(motion))
        )

    def add_pose(self, graph: Any, values: Any, pose: int, guess: Array) -> None:
        """Add a pose, held to the plane, with its first value (3,)."""
        key, at = self.pose_key(pose), self.pose3(guess)
        graph.add(self._gtsam.PriorFactorPose3(key, at, self._flat_noise))
        values.insert(key, at)

    def add_seen(
        self, graph: Any, poses: Sequence[int], landmarks: Sequence[int], points: Array
    ) -> None:
        """Add observations of landmarks at points (K, 3) in the camera frames of poses."""
        make, place = self._gtsam.GenericStereoFactor3D, self._gtsam.StereoPoint2
        noise, calibration, mount = self._stereo_noise, self._calibration, self._mount
        first_pose, first_landmark = self.pose_key(0), self.landmark_key(0)
        measured = (self._camera.to_image(points) @ self._by_image.T).tolist()
        for pose, landmark, at in zip(poses, landmarks, measured, strict=True):
            keys = first_pose + pose, first_landmark + landmark
            graph.add(make(place(*at), noise, *keys, calibration, mount))

    def add_landmark(self, values: Any, landmark: int, guess: Array) -> None:
        """Add a landmark's first value (3,) m in map."""
        values.insert(self.landmark_key(landmark), guess)

    @staticmethod
    def planar(pose: Any) -> Array:
        """Planar pose (3,) of a Pose3."""
        return np.array([pose.x(), pose.y(), pose.rotation().yaw()])

    @staticmethod
    def covariance(marginal: Array, headings_rad: Array) -> Array:
        """Joint covariance (3 K, 3 K) in map of K poses from that (6 K, 6 K) of their tangents."""
        n = len(headings_rad)
        rows = np.add.outer(6 * np.arange(n), _IN_PLANE).ravel()
        turns = np.zeros((3 * n, 3 * n))
        for i, heading in enumerate(headings_rad):
            turns[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = _turn(heading)
        found: Array = turns @ marginal[np.ix_(rows, rows)] @ turns.T
        return (found + found.T) / 2.0

    def _noise(self, planar: Gaussian) -> Any:
        """Noise of a pose's tangent; it is in the axes of the pose itself."""
        covariance = np.diag(np.full(6, _FREE_SIGMA**2))
        in_pose = rotate(planar.covariance, -float(planar.mean[2]))
        covariance[np.ix_(_IN_PLANE, _IN_PLANE)] = in_pose
        return self._gtsam.noiseModel.Gaussian.Covariance(covariance)


class Isam2:
    """GTSAM's iSAM2 over images; between them it follows the wheels.

    Parameters
    ----------
    estimator
        For messages.

    Attributes
    ----------
    camera, model
        What is believed of the camera, and GTSAM's factors by it.
    belief
        Pose in map, of the prior at first.
    """

    def __init__(self, believed: Isam2Options, prior: Prior, estimator: str) -> None:
        gtsam = package("gtsam", "gtsam")
        self._believed, self._estimator = believed, estimator
        self.camera = StereoModel.of(prior.require_stereo(believed.stereo, estimator))
        self.model, self.belief = GtsamModel(self.camera), prior.require_start(estimator)
        self._wheels = WheelPrediction(believed, prior.robot.track_m)
        params = gtsam.ISAM2Params()
        params.setRelinearizeThreshold(believed.relinearize_threshold)
        params.relinearizeSkip = believed.relinearize_skip
        params.setFactorization(believed.factorization.upper())
        self._isam = gtsam.ISAM2(params)
        start, (graph, values) = self.belief, self.model.graph_and_values()
        self.model.add_start(graph, Gaussian(start.mean, start.covariance + FLOOR))
        self.model.add_pose(graph, values, 0, start.mean)
        self._isam.update(graph, values)
        self._pose, self._n_poses = start.mean, 1
        self._known: set[int] = set()
        self._motion = STILL  # since the last image

    def step(self, frame: Frame) -> tuple[Belief, Gaussian, tuple[Array, Ints] | None]:
        """Belief after a Frame, its motion as the graph takes it, and what its image shows."""
        motion = self._wheels.predict(frame)
        loose = loosen(motion)
        self.belief, self._motion = self.belief.then(motion), self._motion.then(loose)
        seen, status = read_observations(frame, self._believed.stereo, self.camera, self._estimator)
        if seen is not None:
            self.belief, self._motion = self.see(self._motion, *seen), STILL
        extras = {"status": status} if status else {}
        return Belief(self.belief.mean.copy(), self.belief.covariance.copy(), extras), loose, seen

    def see(self, motion: Gaussian, points: Array, ids: Ints) -> Gaussian:
        """Pose in map after an image of points (K, 3) m in the camera frame and ids (K,).

        Parameters
        ----------
        motion
            Since the last image, or the start.
        """
        model, i = self.model, self._n_poses
        guess = se2.compose(self._pose, motion.mean)
        graph, values = model.graph_and_values()
        model.add_pose(graph, values, i, guess)
        model.add_motion(graph, i - 1, i, motion)
        landmarks = ids.tolist()
        model.add_seen(graph, [i] * len(landmarks), landmarks, points)
        if not self._known.issuperset(landmarks):
            for landmark, place in zip(landmarks, self.camera.place(guess, points), strict=True):
                if landmark not in self._known:
                    self._known.add(landmark)
                    model.add_landmark(values, landmark, place)
        self._isam.update(graph, values)
        for _ in range(self._believed.updates - 1):
            self._isam.update()
        key = model.pose_key(i)
        self._pose, self._n_poses = model.planar(self._isam.calculateEstimatePose3(key)), i + 1
        marginal = self._isam.marginalCovariance(key)
        return Gaussian(self._pose, model.covariance(marginal, self._pose[2:]))


def _turn(angle_rad: float) -> Array:
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
