"""Blocks of buildings in a grid of streets, for 3D lidar."""

import math
from collections.abc import Callable
from itertools import pairwise, product

import numpy as np

from sim.arrays import Array
from sim.errors import require
from sim.worlds.floor_plan import Plan, box_corners, check_cells, check_margins
from sim.worlds.world import World


def town(
    name: str,
    rng: np.random.Generator,
    n_x: int,
    n_y: int,
    block_m: float,
    street_m: float,
    build: Callable[[Plan, np.random.Generator, Array, float], None],
    trees_per_block: int,
) -> World:
    """Build blocks in a grid of streets; the tour is a closed way along the streets."""
    require(n_x >= 1 and n_y >= 1, f"world.n_x and n_y must be at least 1, got {n_x} and {n_y}")
    check_cells(n_x, n_y)
    check_margins(block_m=block_m - 30.0, street_m=street_m - 6.0)
    plan, pitch = Plan(), block_m + street_m
    corners = [(0, 0), (n_x, 0), (n_x, n_y), (0, n_y), (0, 0)]
    if n_x >= 3 and n_y >= 2:
        corners = [(0, 0), (2, 0), (2, 1), (n_x, 1), (n_x, n_y), (1, n_y), (1, 1), (0, 1), (0, 0)]
    path = [(pitch * i - street_m / 2, pitch * j - street_m / 2) for i, j in corners]
    plan.tour = _rounded(path, radius_m=0.35 * street_m, spacing_m=4.0)
    for x, y in path[:-1]:
        plan.place("corner", *(v + d * street_m / 2 for d in (-1, 1) for v in (x, y)))
    for cell in product(range(n_x), range(n_y)):
        low = pitch * np.array(cell)
        build(plan, rng, low, block_m)
        _trees(plan, rng, low, block_m, trees_per_block)
    return plan.world(name, rng)


def terrace(plan: Plan, rng: np.random.Generator, low: Array, block_m: float) -> None:
    """Houses side by side along the south and the north edge of a block."""
    for far in (False, True):
        x = 0.0
        while x < block_m - 6.0:
            width = min(rng.uniform(7.0, 16.0), block_m - x)
            depth, setback = rng.uniform(9.0, 0.38 * block_m), rng.uniform(0.0, 2.5)
            y = block_m - setback - depth / 2 if far else setback + depth / 2
            centre = low + np.array([x + width / 2, y])
            size = (width - 0.02, depth)
            plan.prism(box_corners(centre.tolist(), size, 0.0), 0.0, rng.uniform(5.0, 16.0))
            x += width + (rng.uniform(2.5, 6.0) if rng.random() < 0.3 else 0.0)


def lawn(plan: Plan, rng: np.random.Generator, low: Array, block_m: float) -> None:
    """Two to four buildings, turned at random; some are L-shaped."""
    for quarter in rng.permutation(4)[: rng.integers(2, 5)]:
        room = block_m / 2
        centre = low + room * np.array([quarter % 2 + 0.5, quarter // 2 + 0.5])
        centre = centre + rng.uniform(-0.06, 0.06, 2) * room
        size = rng.uniform(0.3, 0.62, 2) * room
        yaw, top = rng.uniform(-0.5, 0.5), rng.uniform(6.0, 20.0)
        corners = box_corners(centre.tolist(), size.tolist(), yaw)
        if rng.random() < 0.5:  # an L: the corner that is cut out lies at a quarter of the box
            a, b, c, d = corners
            corners = np.array([a, b, (b + c) / 2, corners.mean(axis=0), (c + d) / 2, d])
        plan.prism(corners, 0.0, top)


def _trees(plan: Plan, rng: np.random.Generator, low: Array, block_m: float, count: int) -> None:
    """Plant trees along the edges of a block, clear of the buildings."""
    for _ in range(count):
        for _ in range(20):
            along, inset = rng.uniform(2.0, block_m - 2.0), rng.uniform(0.5, 5.0)
            far = block_m - inset
            by_edge = ((along, inset), (inset, along), (along, far), (far, along))
            spot = low + by_edge[rng.integers(4)]
            crown = rng.uniform(1.0, 2.2)
            if all(math.dist(spot, d[:2]) > d[2] + crown + 0.3 for d in plan.discs):
                height = rng.uniform(4.5, 9.0)
                plan.tree(spot[0], spot[1], rng.uniform(0.12, 0.35), crown, height)
                break


def _rounded(
    path: list[tuple[float, float]], *, radius_m: float, spacing_m: float
) -> list[tuple[float, float]]:
    """Closed way with each corner cut by an arc, and points about `spacing_m` apart."""
    points = np.array(path[:-1])
    smooth: list[Array] = []
    for before, corner, after in zip(
        np.roll(points, 1, axis=0), points, np.roll(points, -1, axis=0), strict=True
    ):
        into = (before - corner) / np.hypot(*(before - corner))
        out = (after - corner) / np.hypot(*(after - corner))
        t = np.linspace(0.0, 1.0, 7)[:, None]
        a, b = corner + radius_m * into, corner + radius_m * out
        smooth += list((1 - t) ** 2 * a + 2 * t * (1 - t) * corner + t**2 * b)
    # Begin in the middle of a straight, so that the start does not lie in a bend.
    ring = np.array([(smooth[-1] + smooth[0]) / 2, *smooth, (smooth[-1] + smooth[0]) / 2])
    dense = []
    for a, b in pairwise(ring):
        n = max(1, round(math.dist(a, b) / spacing_m))
        dense += [a + share * (b - a) for share in np.arange(n) / n]
    return [(float(x), float(y)) for x, y in [*dense, ring[-1]]]
