"""Variations of a drawn world: a map from another day, walls of other materials, doors."""

import dataclasses
import math
from typing import NamedTuple

import numpy as np

from sim.arrays import Array, Ints
from sim.errors import require
from sim.se2 import transform
from sim.worlds.floor_plan import Plan, gaps_m
from sim.worlds.world import Material, World

_MOVES_TRIED = 50
_STRETCH_M = 2.0  # of a wall of one material, at least


class Shares(NamedTuple):
    """Shares of the objects that have changed, of glass and dark walls, of doorways with doors."""

    changed: float = 0.0
    glass: float = 0.0
    dark: float = 0.0
    doors: float = 0.0


def vary(plan: Plan, world: World, rng: np.random.Generator, shares: Shares) -> World:
    """Return a plan's world with shares of it changed; the generator's own stream stays.

    Objects that have changed stand elsewhere on the map that estimators get, or are on it or in the
    world alone. Walls are glass or dark by stretches of 2 m, or whole faces.

    Raises
    ------
    InputError
        If a share is none.
    """
    earlier, stuff, leaves = rng.spawn(3)
    known_walls, known_wall_z_m = _of_another_day(plan, earlier, shares.changed)
    doors = None
    if shares.doors > 0.0:
        doorways = np.array(plan.doorways, float).reshape(-1, 4)
        doors = doorways[leaves.random(len(doorways)) < shares.doors]
    return dataclasses.replace(
        world,
        known_walls=known_walls,
        known_wall_z_m=known_wall_z_m,
        materials=_materials(plan, stuff, shares.glass, shares.dark),
        doors=doors,
    )


def _materials(plan: Plan, rng: np.random.Generator, glass: float, dark: float) -> Ints | None:
    """Material (W,) of each face; None if all are plaster."""
    require(
        0.0 <= glass <= 1.0 and 0.0 <= dark <= 1.0 and glass + dark <= 1.0,
        f"world.glass_share and dark_share must be shares of one whole, got {glass}, {dark}",
    )
    if glass + dark == 0.0:
        return None
    faces = np.array(plan.faces)
    along_m = np.cumsum(np.hypot(*(faces[:, 2:] - faces[:, :2]).T))
    stretch = (along_m / _STRETCH_M).astype(np.int64)
    drawn = rng.random(stretch[-1] + 1)[stretch]
    kinds = np.select([drawn < glass, drawn < glass + dark], [Material.GLASS, Material.DARK], 0)
    return np.where(plan.on_object, Material.PLASTER, kinds).astype(np.int64)


def _of_another_day(
    plan: Plan, rng: np.random.Generator, share: float
) -> tuple[Array, Array] | tuple[None, None]:
    """Faces (K, 4) and heights (K, 2) with a share of the objects changed.

    A third of them each are somewhere else in the same room, are missing, and have another like
    them near by.
    """
    require(0.0 <= share <= 1.0, f"world.changed_share must lie in [0, 1], got {share}")
    if share == 0.0 or not plan.objects:
        return None, None
    faces, heights = np.array(plan.faces), np.array(plan.heights)
    fixed = faces[~np.array(plan.on_object)]
    kept = np.ones(len(faces), bool)
    added: list[tuple[Array, Array]] = []
    changed = rng.permutation(len(plan.objects))[: round(share * len(plan.objects))]
    for number, which in enumerate(changed):
        rows = slice(*plan.objects[which])
        kept[rows] = number % 3 == 2  # of these another one is added
        if number % 3 != 1:
            added.append((_moved_near(faces[rows], fixed, rng), heights[rows]))
    return (
        np.concatenate([faces[kept], *(moved for moved, _ in added)]),
        np.concatenate([heights[kept], *(own for _, own in added)]),
    )


def _moved_near(faces: Array, walls: Array, rng: np.random.Generator) -> Array:
    """Faces (N, 4) of an object, turned and moved by up to 1.5 m within the room with walls."""
    ends = faces.reshape(-1, 2)
    centre = ends.mean(axis=0)
    for _ in range(_MOVES_TRIED):
        angle, way = rng.uniform(-math.pi, math.pi, 2)
        shift = rng.uniform(0.4, 1.5) * np.array([math.cos(way), math.sin(way)])
        moved = transform([*(centre + shift), angle], ends - centre).reshape(-1, 4)
        through = np.concatenate([centre, centre + shift])[None]
        if not len(walls) or gaps_m(np.vstack([moved, through]), walls).min() > 0.02:
            return moved
    return faces
