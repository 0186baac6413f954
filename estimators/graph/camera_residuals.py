"""Residuals of what a camera sees, landmarks or other robots, and their whitening."""

from dataclasses import dataclass

import numpy as np

from estimators.graph.matrices import times, whitening_of
from estimators.landmarks.sightings import Sightings
from estimators.landmarks.stereo import MIN_DEPTH_M, StereoModel
from sim.arrays import Array, Ints


@dataclass(frozen=True)
class PoseSightings:
    """Poses seen from poses: robots of a team that see one another's markers.

    Attributes
    ----------
    sensor
        What is believed of what sees them.
    seeing_rows, seen_rows
        (K,) who sees whom.
    points_in_camera
        (K, 3) m.
    """

    sensor: Sightings
    seeing_rows: Ints
    seen_rows: Ints
    points_in_camera: Array

    def residuals(self, poses: Array, in_image: bool) -> tuple[Array, Array, Array]:
        """Whitened residuals (K, 3), and derivatives (K, 3, 3) by the seeing and seen pose."""
        camera, seeing = self.sensor.camera, poses[self.seeing_rows]
        markers, points = self.sensor.markers(poses[self.seen_rows]), self.points_in_camera
        off, by_seeing, by_marker = residuals_of(camera, seeing, markers, points, in_image)
        whitening = (
            camera_whitening(camera, seeing, markers)
            if in_image
            else whitening_of(camera.covariance(points))
        )
        by_seen = by_marker * np.array([1.0, 1.0, 0.0])  # its heading is not seen
        return times(whitening, off), whitening @ by_seeing, whitening @ by_seen


def residuals_of(
    camera: StereoModel, poses: Array, landmarks: Array, points: Array, in_image: bool = True
) -> tuple[Array, Array, Array]:
    """Residuals of K observations: predicted less measured.

    In pixels of column, row and disparity if the camera's noise is Gaussian there and `in_image`
    asks for it, else in metres.

    Parameters
    ----------
    poses, landmarks, points
        (K, 3) each: who sees which landmark, and where in the camera frame it was measured.

    Returns
    -------
    tuple
        Residuals (K, 3), and their derivatives (K, 3, 3) by the pose and by the landmark.
    """
    predicted, by_pose, by_landmark = camera.predict(poses, landmarks)
    if not (in_image and camera.in_image):
        return predicted - points, by_pose, by_landmark
    # What is guessed to lie behind the camera is pulled before it
    predicted[:, 2] = np.maximum(predicted[:, 2], MIN_DEPTH_M)
    image = camera.to_image(predicted)
    by_point = -image[:, :, None] * np.array([0.0, 0.0, 1.0])
    by_point[:, 0, 0] = by_point[:, 1, 1] = camera.focal_px
    by_point /= predicted[:, 2, None, None]
    return image - camera.to_image(points), by_point @ by_pose, by_point @ by_landmark


def camera_whitening(camera: StereoModel, poses: Array, landmarks: Array) -> Array:
    """Matrices (K, 3, 3) that make the camera's residuals, `residuals_of`, unit white noise.

    The noise is that at the predicted points where it is not the same everywhere.
    """
    if camera.in_image:
        roots = np.diag(1.0 / np.sqrt(camera.variances_px2))
        return np.broadcast_to(roots, (len(poses), 3, 3))
    return whitening_of(camera.covariance(camera.predict(poses, landmarks)[0]))
