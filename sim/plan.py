"""A plan on which builders draw: walls, boxes, doors, objects kept off a tour, landmarks."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim.errors import InputError
from sim.world import World

Array = NDArray[np.float64]
WALL_HEIGHT_M = 2.5
DESCRIPTOR_SIZE = 128
_PROUD_M = 0.01  # landmarks stand this far off their face, so that rays see them from its side


@dataclass
class Plan:
    """What has been drawn so far, in metres."""

    faces: list[tuple[float, float, float, float]] = field(default_factory=list)
    heights: list[tuple[float, float]] = field(default_factory=list)
    on_object: list[bool] = field(default_factory=list)
    discs: list[tuple[float, float, float]] = field(default_factory=list)
    places: dict[str, list[tuple[float, float, float, float]]] = field(default_factory=dict)
    tour: list[tuple[float, float]] = field(default_factory=list)

    def wall(
        self,
        start: Sequence[float],
        end: Sequence[float],
        *,
        top_m: float = WALL_HEIGHT_M,
        gaps: Iterable[tuple[float, float]] = (),
    ) -> None:
        """Draw a wall from start to end, open at gaps (centre along it, width)."""
        way = np.subtract(end, start)
        length = float(np.hypot(*way))
        unit, begin = way / length, 0.0
        edges = [(c - w / 2, c + w / 2) for c, w in sorted(gaps)]
        for low, high in [*edges, (length, length)]:
            if low - begin > 1e-6:
                a, b = np.asarray(start) + begin * unit, np.asarray(start) + low * unit
                self._face((a[0], a[1], b[0], b[1]), (0.0, top_m), on_object=False)
            begin = max(begin, high)

    def rectangle(self, low: Sequence[float], high: Sequence[float]) -> None:
        """Draw four walls around the rectangle."""
        corners = [(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])]
        for i in range(4):
            self.wall(corners[i], corners[(i + 1) % 4])

    def prism(
        self, corners: ArrayLike, bottom_m: float, top_m: float, *, on_object: bool = True
    ) -> None:
        """Draw the faces of an upright prism over corners (N, 2), counter-clockwise."""
        ring = np.asarray(corners, float)
        for (x1, y1), (x2, y2) in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            self._face((x1, y1, x2, y2), (bottom_m, top_m), on_object=on_object)
        centre = ring.mean(axis=0)
        radius = float(np.max(np.hypot(*(ring - centre).T)))
        self.discs.append((float(centre[0]), float(centre[1]), radius))

    def box(
        self,
        centre: Sequence[float],
        size: Sequence[float] | Array,
        yaw_rad: float,
        top_m: float,
    ) -> None:
        """Draw a box of length and width `size`, turned by `yaw_rad`."""
        self.prism(box_corners(centre, size, yaw_rad), 0.0, top_m)

    def place(self, name: str, x1: float, y1: float, x2: float, y2: float) -> None:
        """Name a rectangle."""
        self.places.setdefault(name, []).append((x1, y1, x2, y2))

    def furnish(
        self,
        rng: np.random.Generator,
        low: Sequence[float],
        high: Sequence[float],
        count: int,
        *,
        size_m: tuple[float, float] = (0.4, 1.4),
        height_m: tuple[float, float] = (0.4, 1.8),
        clearance_m: float = 0.75,
        tries: int = 60,
    ) -> None:
        """Put up to `count` boxes of random size and turn into the rectangle.

        They keep `clearance_m` off the tour, and off walls and each other by a hand's breadth or
        more; one that finds no room is left out.
        """
        for _ in range(count):
            for _ in range(tries):
                size = rng.uniform(*size_m, size=2)
                reach = float(np.hypot(*size)) / 2
                room_low, room_high = np.add(low, reach + 0.1), np.subtract(high, reach + 0.1)
                if np.any(room_low >= room_high):
                    continue
                centre = rng.uniform(room_low, room_high)
                clear_of_tour = self._tour_distance(centre) > reach + clearance_m
                near = [math.dist(centre, d[:2]) > reach + d[2] + 0.15 for d in self.discs]
                if clear_of_tour and all(near):
                    yaw = rng.uniform(0.0, math.pi) if rng.random() < 0.6 else 0.0
                    self.box((centre[0], centre[1]), size, yaw, rng.uniform(*height_m))
                    break

    def tree(self, x: float, y: float, trunk_m: float, crown_m: float, top_m: float) -> None:
        """Draw a tree: a trunk, and a crown from 2.2 m up."""
        self.prism(regular((x, y), trunk_m, 6), 0.0, 2.2)
        self.prism(regular((x, y), crown_m, 8), 2.2, top_m)

    def world(
        self,
        name: str,
        rng: np.random.Generator,
        *,
        n_landmarks: int = 0,
        on_walls_share: float = 0.7,
        look_alike_share: float = 0.0,
    ) -> World:
        """Finish the world, with landmarks scattered over its faces."""
        walls = np.array(self.faces, float).reshape(-1, 4)
        heights = np.array(self.heights, float).reshape(-1, 2)
        landmarks = self._landmarks(rng, n_landmarks, on_walls_share)
        descriptors, alike = make_descriptors(rng, len(landmarks), look_alike_share)
        tour = np.array(self.tour, float).reshape(-1, 2)
        start = np.zeros(3)
        if len(tour) >= 2:
            way = tour[1] - tour[0]
            start = np.array([tour[0, 0], tour[0, 1], math.atan2(way[1], way[0])])
        places = {k: np.array(v, float) for k, v in self.places.items()}
        return World(name, walls, heights, landmarks, descriptors, alike, places, start, tour)

    def _face(self, ends: Sequence[float], height: tuple[float, float], *, on_object: bool) -> None:
        x1, y1, x2, y2 = (float(v) for v in ends)
        self.faces.append((x1, y1, x2, y2))
        self.heights.append((float(height[0]), float(height[1])))
        self.on_object.append(on_object)

    def _tour_distance(self, point: Array) -> float:
        if len(self.tour) < 2:
            return math.inf
        path = np.array(self.tour)
        start, along = path[:-1], np.diff(path, axis=0)
        offset = point - start
        length2 = np.maximum(np.sum(along**2, axis=1), 1e-12)
        share = np.clip(np.sum(offset * along, axis=1) / length2, 0.0, 1.0)
        return float(np.min(np.hypot(*(offset - share[:, None] * along).T)))

    def _landmarks(self, rng: np.random.Generator, count: int, on_walls_share: float) -> Array:
        """Landmarks (count, 3), spread over walls and objects by the faces' lengths."""
        if count == 0:
            return np.zeros((0, 3))
        if not 0.0 <= on_walls_share <= 1.0:
            raise InputError(f"world.on_walls_share must lie in [0, 1], got {on_walls_share}")
        faces, heights = np.array(self.faces), np.array(self.heights)
        objects = np.array(self.on_object)
        length = np.hypot(*(faces[:, 2:] - faces[:, :2]).T)
        on_walls = round(count * on_walls_share) if objects.any() else count
        chosen = []
        for share, mask in ((on_walls, ~objects), (count - on_walls, objects)):
            weight = length * mask * (heights[:, 0] < 0.2)
            if share:
                chosen.append(rng.choice(len(faces), share, p=weight / weight.sum()))
        rows = np.concatenate(chosen)
        way = (faces[rows, 2:] - faces[rows, :2]) / length[rows, None]
        along = rng.uniform(0.02, 0.98, len(rows)) * length[rows]
        # A box is drawn counter-clockwise, so its outside is on the right of each face.
        right = np.stack([way[:, 1], -way[:, 0]], axis=1)
        side = np.where(objects[rows], 1.0, rng.choice([-1.0, 1.0], len(rows)))
        foot = faces[rows, :2] + along[:, None] * way + _PROUD_M * side[:, None] * right
        top = np.minimum(heights[rows, 1] - 0.05, 2.2)
        return np.column_stack([foot, rng.uniform(0.2, np.maximum(top, 0.25))])


def box_corners(centre: Sequence[float], size: Sequence[float] | Array, yaw_rad: float) -> Array:
    """Corners (4, 2), m, counter-clockwise."""
    half = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.asarray(size) / 2
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    corners: Array = half @ np.array([[cos, sin], [-sin, cos]]) + np.asarray(centre)
    return corners


def regular(centre: Sequence[float], radius_m: float, sides: int) -> Array:
    """Corners (sides, 2) of a regular polygon, m, counter-clockwise."""
    angle = 2.0 * math.pi * np.arange(sides) / sides
    corners: Array = np.asarray(centre) + radius_m * np.stack([np.cos(angle), np.sin(angle)], 1)
    return corners


def make_descriptors(
    rng: np.random.Generator, count: int, look_alike_share: float
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """SIFT-like descriptors (count, 128): sparse, non-negative, of unit length.

    `look_alike_share` of the landmarks share theirs with another one, in pairs (the last three
    make a triple if their number is odd); the mask (count,) marks them.
    """
    if not 0.0 <= look_alike_share <= 1.0:
        raise InputError(f"world.look_alike_share must lie in [0, 1], got {look_alike_share}")
    raw = np.maximum(rng.standard_normal((count, DESCRIPTOR_SIZE)) - 0.4, 0.0) ** 1.5
    raw[:, 0] += 1e-3  # never all zero
    alike = np.zeros(count, bool)
    n_alike = round(count * look_alike_share)
    if n_alike >= 2:
        rows = rng.permutation(count)[:n_alike]
        alike[rows] = True
        for first, second in zip(rows[0::2], rows[1::2], strict=False):
            raw[second] = raw[first]
        if n_alike % 2:
            raw[rows[-1]] = raw[rows[0]]
    unit = raw / np.linalg.norm(raw, axis=1, keepdims=True) if count else raw
    return unit.astype(np.float32), alike
