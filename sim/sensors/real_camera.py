"""A camera of landmarks as real detectors are: it misses, misreads, and errs alike for a while."""

import math

import numpy as np

from sim.arrays import Array, Floats, Ints, Values
from sim.errors import require
from sim.options import NonNegative, Positive, Share, options
from sim.sensors.base import Reading, View
from sim.sensors.stereo import StereoCamera, choose, in_field_of_view, points_in_camera
from sim.worlds.world import World


@options("sensors.stereo")
class RealCamera(StereoCamera):
    """A camera that errs in depth and bearing. Estimators assume its noise in pixels."""

    scale: Positive = 1.0
    """Mean of the observed depth over the true one."""
    sigma_depth: NonNegative = 0.0
    """Standard deviation of the depth's error, as a share of the depth."""
    sigma_bearing_rad: NonNegative = 0.0
    """That of the bearing's."""
    lasting_share: Share = 0.0
    """Share of both variances that belongs to errors which one landmark keeps for a while."""
    lasting_s: Positive = 1.0
    """Time in which these fall by a factor of e."""
    detection_share: Share = 1.0
    """Share of the landmarks in view that are seen."""
    detection_s: Positive = 1.0
    """Mean time until it is drawn again whether a landmark is seen."""
    misread_share: Share = 0.0
    """Share of those seen that are taken for another."""
    min_distance_m: NonNegative = 0.0
    """Landmarks that are nearer are not seen."""

    def __post_init__(self) -> None:
        require(
            self.sigma_view_descriptor == StereoCamera.sigma_view_descriptor,
            "sensors.stereo.sigma_view_descriptor has no effect on a RealCamera, whose descriptors "
            "have no noise; leave it out",
        )

    def start(self, rng: np.random.Generator) -> "DetectingEye":  # type: ignore[override]
        """Probe that looks for the world's landmarks."""
        return DetectingEye(self, rng)


class DetectingEye:
    """The camera while it records, with the errors that last from image to image."""

    def __init__(self, camera: RealCamera, rng: np.random.Generator) -> None:
        self._camera, self._rng = camera, rng

    def begin(self, view: View) -> None:
        """Draw which landmarks are found at first, and the errors that last."""
        n = len(view.world.landmarks)
        self._found = self._rng.random(n) < self._camera.detection_share
        self._lasting = self._rng.standard_normal((n, 2))

    def __call__(self, view: View) -> Reading | None:
        """Observe the landmarks in view; None if none is seen."""
        camera, rng, world = self._camera, self._rng, view.world
        self._advance(view.duration_s)
        inside = points_in_camera(camera, view.pose, world.landmarks)
        distant = np.linalg.norm(inside, axis=1) >= camera.min_distance_m
        ids = np.flatnonzero(in_field_of_view(camera, inside) & distant & self._found)
        origin = np.array([*camera.mount.in_map(view.pose)[:2], camera.mount.z_m])
        ids = ids[view.sees(origin, world.landmarks[ids])]
        ids = choose(camera, ids, inside, rng)
        if not len(ids):
            return None
        reading: dict[str, Values] = {
            "points_in_camera": self._observed(inside[ids], ids),
            "descriptors": self._descriptors(world)[ids],
            "true_ids": ids.astype(np.int64),
        }
        if camera.identifies:
            misread = rng.random(len(ids)) < camera.misread_share
            other = rng.integers(len(world.landmarks), size=len(ids))
            reading["ids"] = np.where(misread, other, ids).astype(np.int64)
        return reading

    def _descriptors(self, world: World) -> Floats:
        """Those of the world (L, D), without noise; of no components if it has none."""
        n = len(world.landmarks)
        return world.descriptors if len(world.descriptors) else np.zeros((n, 0), np.float32)

    def _advance(self, lapse_s: float) -> None:
        """Let time pass: first-order Gauss-Markov errors, and detections drawn again."""
        camera, rng, n = self._camera, self._rng, len(self._found)
        redrawn = rng.random(n) >= math.exp(-lapse_s / camera.detection_s)
        self._found = np.where(redrawn, rng.random(n) < camera.detection_share, self._found)
        kept = math.exp(-lapse_s / camera.lasting_s)
        fresh = rng.standard_normal((n, 2))
        self._lasting = kept * self._lasting + math.sqrt(1.0 - kept**2) * fresh

    def _observed(self, points: Array, ids: Ints) -> Array:
        """Points (K, 3) m of the camera frame with errors of depth and bearing."""
        camera = self._camera
        x, y, z = points.T
        fresh = self._rng.standard_normal((len(points), 2))
        share = camera.lasting_share
        errors = math.sqrt(share) * self._lasting[ids] + math.sqrt(1.0 - share) * fresh
        depth = camera.scale * z * np.maximum(1.0 + camera.sigma_depth * errors[:, 0], 0.1)
        bearing = np.arctan2(-x, z) + camera.sigma_bearing_rad * errors[:, 1]
        return np.stack([-depth * np.tan(bearing), y / z * depth, depth], axis=1)
