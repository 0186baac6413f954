"""A plan on which builders draw: walls, boxes, doors, objects clear of the tour, landmarks."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from sim.arrays import Array, ArrayLike, Bools, Floats
from sim.errors import InputError, require
from sim.worlds.world import World, facing_second

WALL_HEIGHT_M = 2.5
DESCRIPTOR_SIZE = 128
CHORD_ERROR_M = 1e-4  # between a polygon and what is round
_MOST_CELLS, _MOST_LANDMARKS = 2_500, 1_000_000  # of a world
_APART_M = 0.12  # between furniture and walls, and among furniture
_PROUD_M = 0.01  # landmarks stand this far off their face, so that rays see them from its side


class NoRoomError(InputError):
    """So many objects do not fit, or do not beside the first ones as chance has put them."""


@dataclass
class Plan:
    """What has been drawn so far, in metres.

    Attributes
    ----------
    faces, heights, on_object
        x1, y1, x2, y2 of each face; its bottom and top; whether it belongs to an object.
    objects
        First row of the faces of each object, and the row after its last.
    floors
        Outlines of the ground one can stand on; none drawn means everywhere.
    solids
        Outline and top of what fills the ground: objects, courts without a door.
    discs
        Centre and radius about each solid.
    places, tour
        As in `World`.
    approaches
        x1, y1, x2, y2 of stretches that furniture keeps clear besides the tour: the ways
        through the doors.
    doorways
        x1, y1, x2, y2 of the gaps in walls.
    """

    faces: list[tuple[float, ...]] = field(default_factory=list)
    heights: list[tuple[float, float]] = field(default_factory=list)
    on_object: list[bool] = field(default_factory=list)
    objects: list[tuple[int, int]] = field(default_factory=list)
    floors: list[Array] = field(default_factory=list)
    solids: list[tuple[Array, float]] = field(default_factory=list)
    discs: list[tuple[float, float, float]] = field(default_factory=list)
    places: dict[str, list[tuple[float, float, float, float]]] = field(default_factory=dict)
    tour: list[tuple[float, float]] = field(default_factory=list)
    approaches: list[tuple[float, ...]] = field(default_factory=list)
    doorways: list[tuple[float, ...]] = field(default_factory=list)

    def wall(
        self,
        start: ArrayLike,
        end: ArrayLike,
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
            if high > low:
                a, b = np.asarray(start) + low * unit, np.asarray(start) + high * unit
                self.doorways.append((*a.tolist(), *b.tolist()))
            begin = max(begin, high)

    def enclosure(self, corners: ArrayLike) -> None:
        """Draw walls round a floor with corners (N, 2)."""
        ring = np.asarray(corners, float)
        for start, end in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            self.wall(start, end)
        self.floors.append(ring)

    def rectangle(self, low: Sequence[float], high: Sequence[float]) -> None:
        """Draw four walls round a rectangular floor."""
        self.enclosure(rectangle_corners(low, high))

    def door(self, centre: ArrayLike, inward: ArrayLike) -> None:
        """Name a door, and keep the metre before and behind it free; `inward` is a unit vector."""
        x, y = middle = np.asarray(centre, float)
        self.approaches.append((*(middle - inward), *(middle + inward)))
        self.place("door", x - 0.6, y - 0.6, x + 0.6, y + 0.6)

    def prism(
        self,
        corners: ArrayLike,
        bottom_m: float,
        top_m: float,
        *,
        on_object: bool = True,
        joined: bool = False,
    ) -> None:
        """Draw the faces of an upright prism over corners (N, 2), counter-clockwise.

        One that is `joined` belongs to the object drawn before, as the legs of a table do.
        """
        ring = np.asarray(corners, float)
        if on_object:
            first = self.objects.pop()[0] if joined else len(self.faces)
            self.objects.append((first, len(self.faces) + len(ring)))
        for (x1, y1), (x2, y2) in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            self._face((x1, y1, x2, y2), (bottom_m, top_m), on_object=on_object)
        self.close(ring, top_m)

    def close(self, corners: ArrayLike, top_m: float = WALL_HEIGHT_M) -> None:
        """Mark ground with corners (N, 2) as solid, without drawing anything."""
        ring = np.asarray(corners, float)
        self.solids.append((ring, top_m))
        centre = ring.mean(axis=0)
        radius = float(np.max(np.hypot(*(ring - centre).T)))
        self.discs.append((float(centre[0]), float(centre[1]), radius))

    def place(self, name: str, x1: float, y1: float, x2: float, y2: float) -> None:
        """Name a rectangle."""
        self.places.setdefault(name, []).append((x1, y1, x2, y2))

    def furnish(
        self,
        rng: np.random.Generator,
        low: ArrayLike,
        high: ArrayLike,
        count: int,
        *,
        size_m: tuple[float, float] = (0.4, 1.4),
        height_m: tuple[float, float] = (0.4, 1.8),
        clearance_m: float = 0.75,
        tries: int = 600,
    ) -> None:
        """Put `count` boxes of random size and turn into the rectangle.

        They keep `clearance_m` off the tour and the doors, and a hand's breadth off walls and
        each other.

        Raises
        ------
        NoRoomError
            If so many do not fit.
        """

        def outline(rng: np.random.Generator) -> Array:
            size = rng.uniform(*size_m, size=2)
            yaw = rng.uniform(0.0, math.pi) if rng.random() < 0.6 else 0.0
            return box_corners((0.0, 0.0), size, yaw)

        def draw(corners: Array, rng: np.random.Generator) -> None:
            self.prism(corners, 0.0, rng.uniform(*height_m))

        self.put(rng, (low, high), count, outline, draw, clearance_m=clearance_m, tries=tries)

    def put(
        self,
        rng: np.random.Generator,
        area: tuple[ArrayLike, ArrayLike],
        count: int,
        outline: Callable[[np.random.Generator], Array],
        draw: Callable[[Array, np.random.Generator], None],
        *,
        clearance_m: float,
        tries: int = 600,
    ) -> None:
        """Put `count` objects into a rectangle from its low to its high corner, as `furnish` does.

        Parameters
        ----------
        outline
            Gives the corners (N, 2) of a convex outline about the origin, counter-clockwise.
        draw
            Draws what stands within an outline (N, 2).

        Raises
        ------
        NoRoomError
            If so many do not fit.
        """
        require(count >= 0, f"world: the number of objects must be zero or more, got {count}")
        least, most = np.array(area[0], float), np.array(area[1], float)
        paths = _near(self._paths(), least - clearance_m, most + clearance_m)
        faces = _near(np.array(self.faces, float).reshape(-1, 4), least, most)
        for placed in range(count):
            for _ in range(tries):
                corners = outline(rng)
                corners = corners + rng.uniform(least, most)
                within = np.all((corners > least + _APART_M) & (corners < most - _APART_M))
                if within and self._fits(corners, faces, paths, clearance_m):
                    draw(corners, rng)
                    edges = np.hstack([corners, np.roll(corners, -1, axis=0)])
                    faces = np.vstack([faces, edges])
                    break
            else:
                width, depth = most - least
                raise NoRoomError(
                    f"only {placed} of {count} objects fit into a room of {width:.1f} x "
                    f"{depth:.1f} m; ask for fewer, or make it larger"
                )

    def tree(self, x: float, y: float, trunk_m: float, crown_m: float, top_m: float) -> None:
        """Draw a tree: a trunk, and a crown from 2.2 m up."""
        self.prism(regular((x, y), trunk_m, 6), 0.0, 2.2)
        self.prism(regular((x, y), crown_m, 8), 2.2, top_m, joined=True)

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
        start = facing_second(tour) if len(tour) >= 2 else np.zeros(3)
        # The smallest first, so that a door is not taken for the room it leads to.
        places = {k: np.array(v, float) for k, v in self.places.items()}
        places = dict(sorted(places.items(), key=lambda item: _mean_area(item[1])))
        return World(name, walls, heights, landmarks, descriptors, alike, places, start, tour)

    def _face(self, ends: Sequence[float], height: tuple[float, float], *, on_object: bool) -> None:
        self.faces.append(tuple(map(float, ends)))
        self.heights.append(height)
        self.on_object.append(on_object)

    def _paths(self) -> Array:
        """Stretches (N, 4) to keep clear: the tour and the ways through the doors."""
        tour = np.array(self.tour, float).reshape(-1, 2)
        legs = np.hstack([tour[:-1], tour[1:]])
        return np.vstack([legs, np.array(self.approaches, float).reshape(-1, 4)])

    def _fits(self, corners: Array, faces: Array, paths: Array, clearance_m: float) -> bool:
        """Whether a convex object stands on a floor, off faces, paths and the other objects."""
        edges = np.hstack([corners, np.roll(corners, -1, axis=0)])
        lowest, highest = corners.min(axis=0), corners.max(axis=0)
        paths = _near(paths, lowest - clearance_m, highest + clearance_m)
        faces = _near(faces, lowest - _APART_M, highest + _APART_M)
        if len(paths) and gaps_m(edges, paths).min() < clearance_m:
            return False
        if len(faces) and gaps_m(edges, faces).min() < _APART_M:
            return False
        # The outlines do not cross, but one may still lie inside the other.
        centre = corners.mean(axis=0)
        if self.floors and not any(inside(centre[None], floor)[0] for floor in self.floors):
            return False
        reach = float(np.max(np.hypot(*(corners - centre).T)))
        return not any(
            inside(centre[None], ring)[0] or inside(ring[:1], corners)[0]
            for (ring, _), (x, y, radius) in zip(self.solids, self.discs, strict=True)
            if math.dist(centre, (x, y)) < reach + radius
        )

    def _landmarks(self, rng: np.random.Generator, count: int, on_walls_share: float) -> Array:
        """Landmarks (count, 3), spread over walls and objects by the faces' lengths."""
        require(
            0 <= count <= _MOST_LANDMARKS,
            f"world.n_landmarks must be from zero to {_MOST_LANDMARKS}, got {count}",
        )
        require(
            0.0 <= on_walls_share <= 1.0,
            f"world.on_walls_share must lie in [0, 1], got {on_walls_share}",
        )
        if not self.faces:
            return np.zeros((0, 3))
        objects = np.array(self.on_object)
        on_walls = round(count * on_walls_share)
        if objects.all() or not objects.any():
            on_walls = 0 if objects.all() else count
        return np.concatenate(
            [
                self._scatter(rng, on_walls, ~objects),
                self._scatter(rng, count - on_walls, objects),
            ]
        )

    def _scatter(self, rng: np.random.Generator, count: int, on: Bools) -> Array:
        """Landmarks (count, 3) just off the faces `on`, where one can stand and see them.

        A point that comes to lie behind an outer wall or in an object is drawn again.
        """
        faces, heights = np.array(self.faces), np.array(self.heights)
        way = faces[:, 2:] - faces[:, :2]
        length = np.hypot(*way.T)
        weight = length * on * (heights[:, 0] < 0.2) * (heights[:, 1] > 0.3)
        found = np.zeros((0, 3))
        while len(found) < count:
            rows = rng.choice(len(faces), count, p=weight / weight.sum())
            right = np.stack([way[rows, 1], -way[rows, 0]], axis=1) / length[rows, None]
            side = rng.choice([-1.0, 1.0], count)
            along = rng.uniform(0.02, 0.98, count)
            foot = faces[rows, :2] + along[:, None] * way[rows]
            foot += _PROUD_M * side[:, None] * right
            z = rng.uniform(0.2, np.minimum(heights[rows, 1] - 0.05, 2.2))
            points = np.column_stack([foot, z])
            found = np.concatenate([found, points[self._open(points)]])
        return found[:count]

    def _open(self, points: Array) -> Bools:
        """Whether points (N, 3) lie over a floor, and not in an object."""
        free = np.full(len(points), not self.floors)
        for ring in self.floors:
            free |= inside(points[:, :2], ring)
        for ring, top in self.solids:
            free &= ~(inside(points[:, :2], ring) & (points[:, 2] < top))
        return free


def rectangle_corners(low: Sequence[float] | Array, high: Sequence[float] | Array) -> Array:
    """Corners (4, 2), m, counter-clockwise."""
    return np.array([(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])])


def inside(points: Array, ring: Array) -> Bools:
    """Whether points (N, 2) lie inside the outline with corners (K, 2), by parity of crossings."""
    within = np.zeros(len(points), bool)
    near = np.all((points >= ring.min(axis=0)) & (points <= ring.max(axis=0)), axis=1)
    x, y = points[near].T
    odd = np.zeros(len(x), bool)
    for (x1, y1), (x2, y2) in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        if y1 != y2:
            odd ^= ((y1 > y) != (y2 > y)) & (x < x1 + (y - y1) * (x2 - x1) / (y2 - y1))
    within[near] = odd
    return within


def gaps_m(first: Array, second: Array) -> Array:
    """Distances (N, M), m, between segments (N, 4) and (M, 4); 0 where they cross."""
    a, b = first[:, None, :], second[None, :, :]
    apart: Array = np.minimum.reduce(
        [
            _to_segment(a[..., :2], b),
            _to_segment(a[..., 2:], b),
            _to_segment(b[..., :2], a),
            _to_segment(b[..., 2:], a),
        ]
    )
    across = (_turn(a, b[..., :2]) * _turn(a, b[..., 2:]) < 0) & (
        _turn(b, a[..., :2]) * _turn(b, a[..., 2:]) < 0
    )
    return np.where(across, 0.0, apart)


def _near(segments: Array, low: Array, high: Array) -> Array:
    """Keep the segments (N, 4) whose bounds meet a rectangle."""
    ends = segments.reshape(-1, 2, 2)
    return segments[np.all((ends.max(axis=1) >= low) & (ends.min(axis=1) <= high), axis=1)]


def _to_segment(points: Array, segments: Array) -> Array:
    start, along = segments[..., :2], segments[..., 2:] - segments[..., :2]
    offset = points - start
    length2 = np.maximum(np.sum(along**2, axis=-1), 1e-12)
    share = np.clip(np.sum(offset * along, axis=-1) / length2, 0.0, 1.0)
    rest = offset - share[..., None] * along
    return np.asarray(np.hypot(rest[..., 0], rest[..., 1]))


def _turn(segments: Array, points: Array) -> Array:
    """Positive where the points lie on the left of the segments."""
    along, offset = segments[..., 2:] - segments[..., :2], points - segments[..., :2]
    return along[..., 0] * offset[..., 1] - along[..., 1] * offset[..., 0]


def _mean_area(rectangles: Array) -> float:
    return float(np.mean(np.prod(rectangles[:, 2:] - rectangles[:, :2], axis=1)))


def box_corners(
    centre: Sequence[float] | Array, size: Sequence[float] | Array, yaw_rad: float
) -> Array:
    """Corners (4, 2), m, counter-clockwise."""
    half = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.asarray(size) / 2
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.asarray(half @ np.array([[cos, sin], [-sin, cos]]) + np.asarray(centre))


def regular(centre: Sequence[float] | Array, radius_m: float, sides: int) -> Array:
    """Corners (sides, 2) of a regular polygon, m, counter-clockwise."""
    angle = 2.0 * math.pi * np.arange(sides) / sides
    return np.asarray(centre) + radius_m * np.stack([np.cos(angle), np.sin(angle)], 1)


def arc_step_rad(radius_m: float) -> float:
    """Angle between corners on an arc whose chords are off it by less than 0.1 mm."""
    return 2.0 * math.acos(max(1.0 - 0.95 * CHORD_ERROR_M / radius_m, 0.0))


def round_corners(centre: Sequence[float] | Array, radius_m: float) -> Array:
    """Corners (N, 2), m, counter-clockwise, of something round: chords err by less than 0.1 mm."""
    return regular(centre, radius_m, max(math.ceil(2.0 * math.pi / arc_step_rad(radius_m)), 8))


def arc_points(
    centre: Sequence[float] | Array, radius_m: float, ends_rad: Sequence[float]
) -> Array:
    """Points (N, 2), m, on an arc between two angles, ends included."""
    sweep = abs(ends_rad[1] - ends_rad[0])
    angle = np.linspace(
        ends_rad[0], ends_rad[1], max(math.ceil(sweep / arc_step_rad(radius_m)), 1) + 1
    )
    return np.asarray(centre) + radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def make_descriptors(
    rng: np.random.Generator, count: int, look_alike_share: float
) -> tuple[Floats, Bools]:
    """SIFT-like descriptors (count, 128): sparse, non-negative, of unit length.

    `look_alike_share` of the landmarks share theirs with another one, in pairs (the last three
    make a triple if their number is odd); the mask (count,) marks them.
    """
    require(
        0.0 <= look_alike_share <= 1.0,
        f"world.look_alike_share must lie in [0, 1], got {look_alike_share}",
    )
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


def check_cells(n_x: int, n_y: int) -> None:
    """Check that a grid of rooms or blocks is one that can be built: InputError."""
    require(
        n_x * n_y <= _MOST_CELLS,
        f"world.n_x and n_y make {n_x * n_y} rooms or blocks; {_MOST_CELLS} are the most",
    )


def check_margins(**margins: float) -> None:
    """Check that what is left over of lengths, m, is positive: InputError names the length."""
    for name, margin in margins.items():
        require(margin > 0.0, f"world.{name} is too small for a robot to pass; make it larger")
