"""A stereo camera that sees the other robots of a team."""

import dataclasses

import numpy as np

from sim.arrays import Array
from sim.options import NonNegative, options
from sim.sensors.base import Field, Probe, Reading, Schema, View
from sim.sensors.stereo import LensOptions, StereoCamera, in_field_of_view, points_in_camera


@options("sensors.robots")
class RobotCamera(LensOptions):
    """Depth, bearing and height of the markers of other robots.

    Each robot carries a marker over its axle. A sighting is a point of the camera frame (z
    forward, x right, y down), m, made from a noisy column, row and disparity as a landmark's is
    (gil2008, eq. (9)).
    """

    marker_z_m: NonNegative = 0.5
    """Height of the markers. One below the top of its robot's body is hidden by it."""

    @property
    def camera(self) -> StereoCamera:
        """The camera, as one that sees landmarks."""
        return StereoCamera(
            **{f.name: getattr(self, f.name) for f in dataclasses.fields(LensOptions)}
        )

    @property
    def schema(self) -> Schema:
        """Points, and robots' numbers if the camera identifies; the true numbers beside them."""
        ids = {"ids": Field("", "i8", ragged=True)} if self.identifies else {}
        return {
            "points_in_camera": Field("m", "f8", (3,), ragged=True),
            **ids,
            "true_ids": Field("", "i8", ragged=True, truth=True),
        }

    def start(self, rng: np.random.Generator) -> Probe:
        """Probe that looks for the other robots."""
        camera = self.camera

        def probe(view: View) -> Reading:
            markers = np.array([[x, y, self.marker_z_m] for x, y, _ in view.others.values()])
            markers, numbers = markers.reshape(-1, 3), np.array([*view.others], np.int64)
            inside = points_in_camera(camera, view.pose, markers)
            origin = np.array([*self.mount.in_map(view.pose)[:2], self.mount.z_m])
            seen = np.flatnonzero(in_field_of_view(camera, inside))
            seen = seen[view.sees(origin, markers[seen])]
            points = camera.measure(inside[seen], rng)
            whole = np.isfinite(points).all(axis=1)
            found = {"points_in_camera": points[whole], "true_ids": numbers[seen[whole]]}
            return found | ({"ids": found["true_ids"]} if self.identifies else {})

        return probe

    def points_in_base(self, reading: Reading) -> Array:
        """Points (K, 3), m, of the robots seen."""
        return self.camera.points_in_base(reading)
