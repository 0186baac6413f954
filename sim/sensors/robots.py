"""A stereo camera that sees the other robots of a team."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field

import numpy as np

from sim.arrays import Array
from sim.sensors.base import Field, Mount, Probe, Reading, Schema, View
from sim.sensors.stereo import StereoCamera, in_field_of_view, points_in_camera
from sim.settings import check_numbers


@dataclass(frozen=True)
class RobotCamera:
    """Depth, bearing and height of the markers of other robots.

    Each robot carries a marker over its axle. A sighting is a point of the camera frame (z
    forward, x right, y down), m, made from a noisy column, row and disparity as a landmark's is
    (gil2008, eq. (9)).

    Parameters
    ----------
    rate_hz
        Images per second.
    focal_px, baseline_m
        Focal length and distance between the cameras.
    fov_horizontal_rad, fov_vertical_rad
        Field of view.
    max_distance_m
        Robots farther away are not seen.
    sigma_column_px, sigma_row_px, sigma_disparity_px
        Noise of the detector.
    identifies
        Whether a sighting comes with the robot's number.
    marker_z_m
        Height of the markers. One below the top of its robot's body is hidden by it.
    mount
        Pose of the left camera; its optical axis is the robot's x axis turned by the yaw.
    """

    rate_hz: float = 5.0
    focal_px: float = 381.0
    baseline_m: float = 0.12
    fov_horizontal_rad: float = math.radians(80.0)
    fov_vertical_rad: float = math.radians(60.0)
    max_distance_m: float = 10.0
    sigma_column_px: float = 1.0
    sigma_row_px: float = 1.0
    sigma_disparity_px: float = 0.5
    identifies: bool = True
    marker_z_m: float = 0.5
    mount: Mount = field(default_factory=lambda: Mount(z_m=0.5))

    def __post_init__(self) -> None:
        check_numbers("sensors.robots", self, (), ("marker_z_m",))
        _ = self.camera  # which checks the rest

    @property
    def camera(self) -> StereoCamera:
        """The camera, as one that sees landmarks."""
        own = {f.name for f in dataclasses.fields(self)} - {"marker_z_m"}
        return StereoCamera(**{name: getattr(self, name) for name in own})

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
