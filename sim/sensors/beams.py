"""Exact ranges of beams with origins of their own, such as those of a sweep, and what they hit."""

import math
from typing import Any

import numpy as np

from sim.arrays import Array, Bools, Ints
from sim.compiled import njit
from sim.sensors.base import Hits
from sim.worlds.world import Material, World

_END_TOLERANCE = 1e-9  # of a face's length


def cast_beams(world: World, scanner: Any, eyes: Array, bearings_rad: Array) -> Hits:
    """Ranges of beams that each have an origin of their own, and what they hit.

    Parameters
    ----------
    world
        Its faces that reach the height of the scanner are seen. A face of glass is met by beams
        whose angle of incidence is below the scanner's `glass_angle_rad`; others pass.
    scanner
        With `mount`, evenly spaced `bearings_rad` (B,) and `max_range_m`.
    eyes
        (B, 3) m, m, rad: poses of the scanner in map, a beam each, near one another.
    bearings_rad
        (B,) of the beams, each near the scanner's own.
    """
    z = scanner.mount.z_m
    level = (world.wall_z_m[:, 0] <= z) & (z <= world.wall_z_m[:, 1])
    materials = world.material_of(level)
    angle_rad = getattr(scanner, "glass_angle_rad", None)
    passing = (materials == Material.GLASS) & (angle_rad is not None)
    nominal = scanner.bearings_rad
    step = float(nominal[1] - nominal[0]) if len(nominal) > 1 else math.pi
    middle = eyes[len(eyes) // 2]
    angles = eyes[:, 2] + bearings_rad
    spread_m = float(np.hypot(*(eyes[:, :2] - middle[:2]).T).max())
    slack_rad = float(np.abs(angles - (middle[2] + nominal)).max()) + 1e-6
    ranges, cosines, faces = _cast_beams(
        np.array(world.walls[level], np.float64, order="C"),
        passing,
        math.cos(angle_rad or 0.0),
        (middle[0], middle[1], middle[2] + float(nominal[0])),
        (step, slack_rad, spread_m, float(scanner.max_range_m)),
        np.array(eyes[:, :2], np.float64, order="C"),
        np.stack([np.cos(angles), np.sin(angles)], axis=1),
    )
    struck = faces >= 0
    kinds = np.where(struck, np.append(materials, 0)[faces], 0)
    return Hits(ranges, cosines, kinds.astype(np.int64))


@njit(error_model="numpy")
def _cast_beams(
    walls: Array,
    passing: Bools,
    min_cos: float,
    middle: tuple[float, float, float],
    about: tuple[float, float, float, float],
    origins: Array,
    ways: Array,
) -> tuple[Array, Array, Ints]:
    """Ranges, cosines of incidence and faces (B,) of beams; see `cast_beams`.

    A face is tried against the beams whose bearings from the middle origin meet it, give or take
    how far they are off: `about` is step, slack, spread, greatest range.
    """
    x, y, first = middle
    step, slack, spread, most_m = about
    n = len(ways)
    turn = 2.0 * math.pi / step
    ranges, cosines, faces = np.full(n, np.inf), np.zeros(n), np.full(n, -1)
    for i in range(len(walls)):
        ax, ay, bx, by = walls[i, 0] - x, walls[i, 1] - y, walls[i, 2] - x, walls[i, 3] - y
        tx, ty = bx - ax, by - ay
        share = min(max(-(ax * tx + ay * ty) / (tx * tx + ty * ty), 0.0), 1.0)
        near = math.hypot(ax + share * tx, ay + share * ty)
        if near - spread > most_m:
            continue
        begin, count = 0.0, turn
        if near > 2.0 * spread + 1e-3:
            begin_rad = math.atan2(ay, ax)
            across = math.atan2(ax * by - ay * bx, ax * bx + ay * by)  # from one end to the other
            margin = slack + 2.0 * spread / near
            begin = (min(begin_rad, begin_rad + across) - margin - first) / step
            begin -= turn * math.floor(begin / turn)
            count = min((abs(across) + 2.0 * margin) / step, turn)
        length = math.hypot(tx, ty)
        for shift in (0.0, turn):
            low = max(math.ceil(begin - shift), 0)
            for j in range(low, min(math.floor(begin - shift + count), n - 1) + 1):
                ox, oy = walls[i, 0] - origins[j, 0], walls[i, 1] - origins[j, 1]
                dx, dy = ways[j, 0], ways[j, 1]
                across_way = dx * ty - dy * tx
                along = (ox * ty - oy * tx) / across_way
                place = (ox * dy - oy * dx) / across_way
                inside = (place >= -_END_TOLERANCE) & (place <= 1.0 + _END_TOLERANCE)
                if not (inside & (along >= 0.0) & (along < ranges[j])):
                    continue
                cosine = abs(across_way) / length
                if passing[i] and cosine < min_cos:
                    continue
                if along <= most_m:
                    ranges[j], cosines[j], faces[j] = along, cosine, i
    return ranges, cosines, faces
