"""World: upright walls, point landmarks and named places, in the frame `map` (metres)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from sim.arrays import Array, Bools, Floats, Ints
from sim.errors import InputError, require


class Material(IntEnum):
    """What a face is made of, as a laser sees it."""

    PLASTER = 0
    GLASS = 1
    DARK = 2


REMISSION = {Material.PLASTER: 0.8, Material.GLASS: 0.8, Material.DARK: 0.024}
"""Share of the light that comes back at right angles: plaster, glass met so that it mirrors, and
black foam rubber (SICK, LMS5xx operating instructions, 2021, sec. 3.6.4: plaster about 100 %, black
foam rubber 2.4 %; paint takes a fifth)."""


def facing_second(waypoints: Array) -> Array:
    """Pose (3,) on the first of the way-points (P, 2), facing the second."""
    x, y = waypoints[0]
    along = waypoints[1] - waypoints[0]
    return np.array([x, y, math.atan2(along[1], along[0])])


@dataclass(frozen=True)
class World:
    """What the robot drives through: vertical faces, landmarks, and a tour of free space.

    Attributes
    ----------
    name
        For titles and tables.
    walls
        (W, 4) m: x1, y1, x2, y2 of the foot of each vertical face; a box is four of them. Faces
        have no thickness and are seen from both sides.
    wall_z_m
        (W, 2) m: bottom and top of each face.
    landmarks
        (L, 3) m: points a camera can recognise.
    descriptors
        (L, D) float32 unit vectors, what the camera recognises them by; D may be 0.
    look_alike
        (L,) bool: whether another landmark has the same descriptor.
    places
        Name of a place (`corridor_bare`, `room`, ...) to its rectangles (R, 4) m: x_min, y_min,
        x_max, y_max.
    start_pose
        (3,) m, m, rad: where a robot starts unless its route says otherwise.
    waypoints
        (P, 2) m: a tour through free space that passes every kind of place.
    known_walls, known_wall_z_m
        (K, 4) and (K, 2) m: faces of the map of another day, which estimators get; None where
        nothing has changed since. Landmarks are as they are driven past.
    materials
        (W,) `Material` of each face; None where all are plaster.
    doors
        (D, 4) m: feet of doors that open and close, as they are when closed; None without any.
    """

    name: str
    walls: Array
    wall_z_m: Array
    landmarks: Array = field(default_factory=lambda: np.zeros((0, 3)))
    descriptors: Floats = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    look_alike: Bools = field(default_factory=lambda: np.zeros(0, bool))
    places: dict[str, Array] = field(default_factory=dict)
    start_pose: Array = field(default_factory=lambda: np.zeros(3))
    waypoints: Array = field(default_factory=lambda: np.zeros((0, 2)))
    known_walls: Array | None = None
    known_wall_z_m: Array | None = None
    materials: Ints | None = None
    doors: Array | None = None

    def __post_init__(self) -> None:
        shapes = {
            "walls": (self.walls, (len(self.walls), 4)),
            "wall_z_m": (self.wall_z_m, (len(self.walls), 2)),
            "landmarks": (self.landmarks, (len(self.landmarks), 3)),
            "start_pose": (self.start_pose, (3,)),
            "waypoints": (self.waypoints, (len(self.waypoints), 2)),
            **{f"places.{k}": (v, (len(v), 4)) for k, v in self.places.items()},
        }
        if self.doors is not None:
            shapes["doors"] = self.doors, (len(self.doors), 4)
        if self.known_walls is not None and self.known_wall_z_m is not None:
            shapes["known_walls"] = self.known_walls, (len(self.known_walls), 4)
            shapes["known_wall_z_m"] = self.known_wall_z_m, (len(self.known_walls), 2)
        for key, (values, shape) in shapes.items():
            require(
                np.shape(values) == shape,
                f"world {self.name}: {key} must have shape {shape}, got {np.shape(values)}",
            )
            require(np.all(np.isfinite(values)), f"world {self.name}: {key} must be finite numbers")
        require(
            len(self.descriptors) in (0, len(self.landmarks)),
            f"world {self.name}: {len(self.descriptors)} descriptors for "
            f"{len(self.landmarks)} landmarks",
        )
        require(
            np.ndim(self.descriptors) == 2
            and np.shape(self.look_alike) in ((0,), (len(self.landmarks),)),
            f"world {self.name}: its L = {len(self.landmarks)} landmarks need descriptors of shape "
            "(L, D) and look_alike of shape (L,)",
        )
        if self.materials is not None:
            require(
                np.shape(self.materials) == (len(self.walls),)
                and np.isin(self.materials, [*Material]).all(),
                f"world {self.name}: materials must be numbers of Material, one a wall",
            )
        require(
            (self.known_walls is None) == (self.known_wall_z_m is None),
            f"world {self.name}: known_walls and known_wall_z_m go together",
        )
        for bad in np.flatnonzero(np.hypot(*(self.walls[:, 2:] - self.walls[:, :2]).T) < 1e-6):
            raise InputError(f"world {self.name}: wall {bad} has no length; give it two ends")
        for bad in np.flatnonzero(self.wall_z_m[:, 0] >= self.wall_z_m[:, 1]):
            raise InputError(f"world {self.name}: wall {bad} has its top below its bottom")

    @property
    def known(self) -> World:
        """The world as its map has it, which may be of another day."""
        if self.known_walls is None or self.known_wall_z_m is None:
            return self
        return replace(
            self,
            walls=self.known_walls,
            wall_z_m=self.known_wall_z_m,
            known_walls=None,
            known_wall_z_m=None,
            materials=None,
        )

    def material_of(self, faces: Bools) -> Ints:
        """Materials (N,) of the faces of a mask (W,)."""
        if self.materials is None:
            return np.zeros(int(faces.sum()), np.int64)
        return self.materials[faces]

    @property
    def bounds_m(self) -> Array:
        """(4,) m: x_min, y_min, x_max, y_max of everything in the world."""
        points = np.concatenate(
            [
                self.walls[:, :2],
                self.walls[:, 2:],
                self.landmarks[:, :2],
                self.start_pose[None, :2],
                self.waypoints,
            ]
        )
        return np.concatenate([points.min(axis=0), points.max(axis=0)])

    def as_map(self) -> World:
        """Return what a map shows of the world: neither where a robot starts, nor its tour.

        Nor does it show what has changed since, of what walls are made, and doors.
        """
        return replace(
            self.known,
            start_pose=np.zeros(3),
            waypoints=np.zeros((0, 2)),
            materials=None,
            doors=None,
        )

    def place_of(self, points_in_world: Array) -> NDArray[np.str_]:
        """Name of the first place that holds each point (N, 2), or an empty string."""
        points = np.asarray(points_in_world, float)
        names = np.full(len(points), "", dtype="U32")
        for name, rectangles in self.places.items():
            low, high = rectangles[:, None, :2], rectangles[:, None, 2:]
            inside = np.any(np.all((points >= low) & (points <= high), axis=-1), axis=0)
            names[inside & (names == "")] = name
        return names

    def clearance_m(self, point_in_world: Array) -> float:
        """Distance from a point (2,) to the nearest wall, m; inf in an empty world."""
        start, along = self.walls[:, :2], self.walls[:, 2:] - self.walls[:, :2]
        offset = np.asarray(point_in_world, float)[:2] - start
        share = np.clip(np.sum(offset * along, axis=1) / np.sum(along**2, axis=1), 0.0, 1.0)
        return float(np.hypot(*(offset - share[:, None] * along).T).min(initial=np.inf))
