"""Exact ranges to the upright faces of a World, without a physics engine.

The planar caster draws every face into a buffer of inverse ranges, as a depth buffer does: along
a straight wall n . p = c the inverse range of the beam with direction d is (n . d) / c, which is
linear in d, so a wall costs one multiply-add and one maximum for each beam between its ends.

Ends are closed: a beam through the end of a face, to 1e-9 of the beam spacing, hits it. A beam
that runs along a face hits its nearer end, and a sensor standing on a face (within 1e-12 m) has
range 0 on all beams. In the kernels bearings are counted in beams from the first one, in
[0, turn), where `turn` is the full circle and `phase` the first beam's angle in map, in rad.
"""

import math

import numpy as np

from sim.arrays import Array, ArrayLike, Bools, Ints
from sim.compiled import njit
from sim.sensors import Laser, Lidar3D
from sim.worlds.world import World

IGNORED_NEAR_POINT_M = 0.005

_END_TOLERANCE = 1e-9  # of the beam spacing; of a face's length in `visible`
_EDGE_ON_M = 1e-6  # a face whose line passes the sensor nearer than this is drawn with care
_TOUCHING_M = 1e-12


class SegmentCaster:
    """A planar laser in a World: noise-free ranges at any pose.

    Parameters
    ----------
    world
        Its faces that reach the height of the laser are seen, from both sides.
    laser
        Beams, mounting height and greatest range. The noise and the least range are left to
        `Laser.measure`.
    """

    def __init__(self, world: World, laser: Laser) -> None:
        z = laser.mount.z_m
        bearings = laser.bearings_rad
        step = float(bearings[1] - bearings[0]) if laser.n_beams > 1 else math.pi
        level = (world.wall_z_m[:, 0] <= z) & (z <= world.wall_z_m[:, 1])
        directions = np.stack([np.cos(bearings), np.sin(bearings)])
        self._prepared = (
            _chains(world.walls[level]),
            directions,
            bool(directions[0].min() > -_END_TOLERANCE),
            float(bearings[0]),
            step,
            float(laser.max_range_m),
        )

    def cast(self, T_world_sensor: ArrayLike) -> Array:
        """Ranges (n_beams,), m, from a pose (3,) m, m, rad; +inf where nothing is in range."""
        if np.size(T_world_sensor) != 3:
            raise ValueError(f"cast needs one pose (3,), got {np.shape(T_world_sensor)}")
        return np.asarray(self.cast_many(np.reshape(T_world_sensor, (1, 3)))[0])

    def cast_many(self, T_world_sensor: ArrayLike) -> Array:
        """Ranges (N, n_beams), m, from poses (N, 3) m, m, rad; +inf where nothing is in range."""
        poses = np.array(T_world_sensor, np.float64, order="C")
        if poses.ndim != 2 or poses.shape[1] != 3:
            raise ValueError(f"cast_many needs poses (N, 3), got {poses.shape}")
        return _cast(poses, *self._prepared)


def cast_lidar(world: World, lidar: Lidar3D, T_world_sensor: ArrayLike) -> Array:
    """Slant ranges of a 3D lidar to the faces and the ground plane z = 0.

    The faces are open at the top: a beam that passes over a near face may hit the inside of a
    far one.

    Parameters
    ----------
    world, lidar
        The lidar is level, at the height of its mount.
    T_world_sensor
        (3,) m, m, rad.

    Returns
    -------
    Array
        (n_rings, n_azimuths) m; +inf where nothing is in range.
    """
    x, y, heading = np.asarray(T_world_sensor, np.float64).tolist()
    azimuths, elevations = lidar.azimuths_rad, lidar.elevations_rad
    ranges: Array = _cast_lidar(
        (x, y, heading, float(lidar.mount.z_m)),
        np.array(world.walls.T, np.float64, order="C"),
        np.array(world.wall_z_m.T, np.float64, order="C"),
        np.stack([np.cos(azimuths), np.sin(azimuths)]),
        float(azimuths[0]),
        np.tan(elevations),
    )
    ranges /= np.cos(elevations)[:, None]
    ranges[ranges > lidar.max_range_m] = np.inf
    return ranges


def visible(world: World, origin_in_world: ArrayLike, points_in_world: ArrayLike) -> Bools:
    """Whether no face of the World stands between an origin and each point.

    Parameters
    ----------
    world
        A face hides what lies behind it between its bottom and its top, ends included. A face
        seen exactly along its plane hides nothing.
    origin_in_world
        (3,) m.
    points_in_world
        (N, 3) m; a face within 5 mm of the point, along the sight line, does not hide it, so
        that points may lie on faces.

    Returns
    -------
    Bools
        (N,).
    """
    return _visible(
        np.array(origin_in_world, np.float64),
        np.array(points_in_world, np.float64, order="C").reshape(-1, 3),
        np.array(world.walls.T, np.float64, order="C"),
        np.array(world.wall_z_m.T, np.float64, order="C"),
    )


def _chains(walls: Array) -> Array:
    """Faces (W, 4) as chains of corners, so that neighbours share the work on a corner.

    A chain goes on as long as each face starts where the one before ends.

    Returns
    -------
    Array
        (5, K), one column a corner: x, y, then of the face from this corner to the next: the
        centre x, y and squared radius of a disc, m and m^2. Outside the disc only the side of
        the face that has the sensor on its right can be seen; that is known of convex closed
        chains, which are turned clockwise. It is infinite for other faces, and -1 where the
        chain ends and no face follows.
    """
    breaks = 1 + np.flatnonzero(np.any(walls[1:, :2] != walls[:-1, 2:], axis=1))
    chains = [part for part in np.split(walls, breaks) if len(part)]
    columns = [_chain(np.vstack([part[:, :2], part[-1:, 2:]])) for part in chains]
    return np.concatenate([np.zeros((5, 0)), *columns], axis=1)


def _chain(corners: Array) -> Array:
    """Columns (5, K) of `_chains` for one chain of corners (K, 2)."""
    disc = np.array([0.0, 0.0, np.inf])
    if len(corners) > 3 and np.array_equal(corners[0], corners[-1]):
        along = np.diff(corners, axis=0)
        ahead = np.roll(along, -1, axis=0)
        cross = along[:, 0] * ahead[:, 1] - along[:, 1] * ahead[:, 0]
        turns = np.arctan2(cross, np.sum(along * ahead, axis=1))
        if abs(turns.sum()) < 7.0 and (np.all(turns > 0.0) or np.all(turns < 0.0)):
            corners = corners[::-1] if turns[0] > 0.0 else corners
            centre = corners[:-1].mean(axis=0)
            radius2 = np.max(np.sum((corners - centre) ** 2, axis=1))
            disc = np.array([*centre, radius2 * (1.0 + 1e-9)])
    columns = np.vstack([corners.T, np.repeat(disc[:, None], len(corners), axis=1)])
    columns[4, -1] = -1.0
    return columns


@njit(error_model="numpy", fastmath={"contract"})
def _cast(
    poses: Array,
    chains: Array,
    directions: Array,
    forward: bool,
    first_rad: float,
    step_rad: float,
    max_range_m: float,
) -> Array:
    """Ranges (N, n_beams), m, from poses (N, 3)."""
    px, py, cosines, sines = chains[0], chains[1], directions[0], directions[1]
    turn = 2.0 * math.pi / step_rad
    nearness = np.empty(cosines.size)  # inverse range, 1/m
    ranges = np.empty((poses.shape[0], cosines.size))
    for i in range(poses.shape[0]):
        x, y, heading = poses[i, 0], poses[i, 1], poses[i, 2]
        if not math.isfinite(x + y + heading):
            raise ValueError("a pose to cast from must be finite")
        phase = _wrapped(heading + first_rad)
        cos, sin = math.cos(heading), math.sin(heading)
        nearness[:] = 0.0
        bearing, corner = 0.0, -1  # of the last corner that was needed, in beams
        for k in _faces_in_view(x, y, cos, sin, forward, chains):
            ax, ay, bx, by = px[k] - x, py[k] - y, px[k + 1] - x, py[k + 1] - y
            nx, ny = py[k + 1] - py[k], px[k] - px[k + 1]
            c = nx * ax + ny * ay
            begin = bearing if corner == k else _bearing(ax, ay, phase, step_rad)
            bearing, corner = _bearing(bx, by, phase, step_rad), k + 1
            end = bearing
            if c < 0.0:
                ax, ay, bx, by = bx, by, ax, ay
                begin, end = end, begin
            end = end + turn if end < begin else end
            edge_on = c * c <= _EDGE_ON_M * _EDGE_ON_M * (nx * nx + ny * ny)
            if edge_on or end - begin > 0.75 * turn:
                aim = heading, phase, step_rad
                _draw_edge_on(ax, ay, bx, by, aim, directions, nearness)
                continue
            begin -= _END_TOLERANCE
            end += _END_TOLERANCE
            per_c = 1.0 / c
            gx, gy = (nx * cos + ny * sin) * per_c, (ny * cos - nx * sin) * per_c
            _draw(nearness, cosines, sines, begin, end, gx, gy)
            if end >= turn:
                _draw(nearness, cosines, sines, begin - turn, end - turn, gx, gy)
        for j in range(nearness.size):
            r = 1.0 / nearness[j]
            ranges[i, j] = r if r <= max_range_m else np.inf
    return ranges


@njit(error_model="numpy", fastmath={"contract"})
def _faces_in_view(
    x: float, y: float, cos: float, sin: float, forward: bool, chains: Array
) -> Ints:
    """Faces that may cover a beam.

    Hidden are the backs of convex chains and, if all beams point forward, what lies behind.
    """
    px, py, centre_x, centre_y, radius2 = chains[0], chains[1], chains[2], chains[3], chains[4]
    seen = np.zeros(px.size, np.bool_)
    for k in range(px.size - 1):
        ax, ay, bx, by = px[k] - x, py[k] - y, px[k + 1] - x, py[k + 1] - y
        c = (by - ay) * ax + (ax - bx) * ay
        ox, oy = x - centre_x[k], y - centre_y[k]
        front = (c >= 0.0) | (ox * ox + oy * oy <= radius2[k])
        ahead = max(cos * ax + sin * ay, cos * bx + sin * by) > -_EDGE_ON_M
        seen[k] = front & (ahead | (not forward)) & (radius2[k] >= 0.0)
    return np.flatnonzero(seen)


@njit()
def _wrapped(angle_rad: float) -> float:
    """The angle in [-pi, pi]."""
    return angle_rad - 2.0 * math.pi * math.floor(angle_rad / (2.0 * math.pi) + 0.5)


@njit(error_model="numpy")
def _bearing(dx: float, dy: float, phase: float, step_rad: float) -> float:
    """The bearing of a corner, in beams, in [0, turn]."""
    angle = math.atan2(dy, dx) - phase
    return (angle if angle >= 0.0 else angle + 2.0 * math.pi) / step_rad


@njit(fastmath={"contract"})
def _draw(
    nearness: Array, cosines: Array, sines: Array, begin: float, end: float, gx: float, gy: float
) -> None:
    """Draw one face into the beams from `begin` to `end`."""
    covered = slice(max(math.ceil(begin), 0), min(math.floor(end), nearness.size - 1) + 1)
    row, cos, sin = nearness[covered], cosines[covered], sines[covered]
    for j in range(row.size):
        v = gx * cos[j] + gy * sin[j]
        row[j] = v if v > row[j] else row[j]


@njit(error_model="numpy")
def _draw_edge_on(
    ax: float,
    ay: float,
    bx: float,
    by: float,
    aim: tuple[float, float, float],
    directions: Array,
    nearness: Array,
) -> None:
    """Draw a face that is seen along its plane, or touched, with its range kept on the face."""
    heading, phase, step_rad = aim
    turn = 2.0 * math.pi / step_rad
    last = nearness.size - 1
    begin, end, gx, gy, least, most = _face(ax, ay, bx, by, heading, phase, step_rad)
    for shift in (0.0, turn):
        start = max(math.ceil(begin - shift), 0)
        for j in range(start, min(math.floor(end - shift), last) + 1):
            v = directions[0, j] * gx + directions[1, j] * gy
            nearness[j] = max(nearness[j], min(max(v, least), most))


@njit(error_model="numpy")
def _face(
    ax: float, ay: float, bx: float, by: float, heading: float, phase: float, step_rad: float
) -> tuple[float, float, float, float, float, float]:
    """Beams a face covers and its inverse range, whatever its place, from its ends less the sensor.

    Returns
    -------
    tuple of float
        begin and end in beams (begin <= end, begin < turn), widened by the tolerance; (gx, gy),
        1/m, whose product with a beam's direction is its inverse range; the bounds to keep that
        in. A face that touches the sensor covers all beams at inverse range inf.
    """
    turn = 2.0 * math.pi / step_rad
    nx, ny = by - ay, ax - bx
    share = (ax * ny - ay * nx) / (nx * nx + ny * ny)
    share = min(max(share, 0.0), 1.0)
    nearest = math.hypot(ax - share * ny, ay + share * nx)
    if nearest <= _TOUCHING_M:
        return 0.0, turn, 0.0, 0.0, np.inf, np.inf
    farthest = max(math.hypot(ax, ay), math.hypot(bx, by))
    begin = (math.atan2(ay, ax) - phase) / step_rad
    end = (math.atan2(by, bx) - phase) / step_rad
    c = nx * ax + ny * ay
    if c < 0.0:
        begin, end = end, begin
    begin -= turn * math.floor(begin / turn)
    end -= turn * math.floor(end / turn)
    end = end + turn if end < begin else end
    if end - begin > 0.75 * turn:  # edge-on, and rounding has swapped the ends
        begin, end = end - turn, begin
    per_c = 1.0 / c if c != 0.0 else 0.0
    cos, sin = math.cos(heading), math.sin(heading)
    gx, gy = (nx * cos + ny * sin) * per_c, (ny * cos - nx * sin) * per_c
    least = 1.0 / farthest if c != 0.0 else 1.0 / nearest
    return begin - _END_TOLERANCE, end + _END_TOLERANCE, gx, gy, least, 1.0 / nearest


@njit(error_model="numpy")
def _cast_lidar(
    pose: tuple[float, float, float, float],
    walls: Array,
    wall_z: Array,
    directions: Array,
    first_rad: float,
    slopes: Array,
) -> Array:
    """Horizontal ranges (rings, azimuths), m, from x, y, heading and height z.

    A ring of slope t meets a face at inverse range v if (bottom - z) v <= t <= (top - z) v.
    """
    x, y, heading, z = pose
    n_azimuths, n_rings = directions.shape[1], slopes.size
    turn = float(n_azimuths)
    step_rad = 2.0 * math.pi / turn
    phase = _wrapped(heading + first_rad)
    nearness = np.empty((n_azimuths, n_rings))
    for r in range(n_rings):
        ground = -slopes[r] / z if slopes[r] != 0.0 else 0.0
        nearness[:, r] = max(ground, 0.0)
    for i in range(walls.shape[1]):
        begin, end, gx, gy, least, most = _face(
            walls[0, i] - x,
            walls[1, i] - y,
            walls[2, i] - x,
            walls[3, i] - y,
            heading,
            phase,
            step_rad,
        )
        bottom, top = wall_z[0, i] - z, wall_z[1, i] - z
        for shift in (0.0, turn):
            start = max(math.ceil(begin - shift), 0)
            for j in range(start, min(math.floor(end - shift), n_azimuths - 1) + 1):
                v = directions[0, j] * gx + directions[1, j] * gy
                v = min(max(v, least), most)
                low, high = bottom * v, top * v
                row = nearness[j]
                for r in range(n_rings):
                    if (low <= slopes[r]) & (slopes[r] <= high) & (v > row[r]):
                        row[r] = v
    return 1.0 / nearness.T


@njit(error_model="numpy")
def _visible(origin: Array, points: Array, walls: Array, wall_z: Array) -> Bools:
    """See `visible`; walls (4, W) and wall_z (2, W).

    The sight line origin + s p crosses a face a + t (b - a) at s = c / (n . p) and
    t = (a x p) / (n . p); where n . p = 0 no comparison holds.
    """
    x, y, z = origin[0], origin[1], origin[2]
    x1, y1, x2, y2 = walls[0], walls[1], walls[2], walls[3]
    bottom, top = wall_z[0], wall_z[1]
    seen = np.empty(points.shape[0], np.bool_)
    for k in range(points.shape[0]):
        px, py, pz = points[k, 0] - x, points[k, 1] - y, points[k, 2] - z
        distance = math.sqrt(px * px + py * py + pz * pz)
        s_most = 1.0 - IGNORED_NEAR_POINT_M / distance
        hits = 0
        for i in range(x1.size):
            ax, ay = x1[i] - x, y1[i] - y
            nx, ny = y2[i] - y1[i], x1[i] - x2[i]
            inverse = 1.0 / (nx * px + ny * py)
            s = (nx * ax + ny * ay) * inverse
            t = (ax * py - ay * px) * inverse
            height = z + s * pz
            between = (s >= 0.0) & (s <= s_most)
            across = (t >= -_END_TOLERANCE) & (t <= 1.0 + _END_TOLERANCE)
            hits += between & across & (height >= bottom[i]) & (height <= top[i])
        seen[k] = hits == 0
    return seen
