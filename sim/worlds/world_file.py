"""A user's world, written in YAML.

```yaml
name: lab
walls:                      # feet of upright walls, m
  - [0, 0, 8, 0]
  - {from: [8, 0], to: [8, 6], z: [0, 2.5]}
boxes:
  - {x: 2, y: 3, length: 1.0, width: 0.5, heading_deg: 30, height: 0.8}
landmarks: [[1, 0.01, 1.2]]
places: {room: [[0, 0, 8, 6]]}
waypoints: [[1, 1], [7, 1], [7, 5]]
start_pose: [1, 1, 0]       # x m, y m, heading deg; without it, the first way-point
```
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sim.errors import InputError, describe_unknown, require
from sim.worlds.floor_plan import WALL_HEIGHT_M, box_corners, gaps_m, make_descriptors
from sim.worlds.world import World, facing_second
from sim.yaml_file import number, read_yaml

_KEYS = ("name", "walls", "boxes", "landmarks", "places", "waypoints", "start_pose")
_BOX_KEYS = ("x", "y", "length", "width", "heading_deg", "height")


def read_world(path: Path) -> World:
    """Read a world file.

    Raises
    ------
    InputError
        Naming the file, the entry and what it must be.
    """
    document = read_yaml(path)
    require(
        isinstance(document, Mapping), f"{path}: must hold keys such as walls, boxes, waypoints"
    )
    _check_keys(document, _KEYS, str(path))
    faces = [
        _wall(entry, f"{path}: walls[{i}]")
        for i, entry in enumerate(_list(document, "walls", path))
    ]
    for i, entry in enumerate(_list(document, "boxes", path)):
        faces += _box(entry, f"{path}: boxes[{i}]")
    walls = np.array([ends for ends, _ in faces], float).reshape(-1, 4)
    landmarks = _rows(document, "landmarks", 3, path)
    waypoints = _rows(document, "waypoints", 2, path)
    descriptors, alike = make_descriptors(np.random.default_rng(0), len(landmarks), 0.0)
    check_tour(waypoints, walls, path)
    named = document.get("places") or {}
    require(
        isinstance(named, Mapping),
        f"{path}: places must map names to lists of x_min, y_min, x_max, y_max",
    )
    places = {str(k): _rows(named, k, 4, path, prefix="places.") for k in named}
    for name, rectangles in places.items():
        for bad in np.flatnonzero(np.any(rectangles[:, :2] >= rectangles[:, 2:], axis=1)):
            raise InputError(
                f"{path}: places.{name}[{bad}] must have x_min < x_max and y_min < y_max"
            )
    return World(
        name=str(document.get("name", path.stem)),
        walls=walls,
        wall_z_m=np.array([z for _, z in faces], float).reshape(-1, 2),
        landmarks=landmarks,
        descriptors=descriptors,
        look_alike=alike,
        places=places,
        start_pose=_start(document, waypoints, path),
        waypoints=waypoints,
    )


def check_tour(waypoints: Any, walls: Any, path: Path) -> None:
    """Refuse a tour that runs through a wall: no robot can follow it."""
    for i in range(len(waypoints) - 1 if len(walls) else 0):
        leg = np.concatenate(waypoints[i : i + 2])[None]
        require(
            gaps_m(leg, walls).min() != 0.0,
            f"{path}: the way from waypoints[{i}] to waypoints[{i + 1}] runs through a wall or "
            "a box; lead it round",
        )


def _start(document: Mapping[str, Any], waypoints: Any, path: Path) -> Any:
    if document.get("start_pose") is not None:
        x, y, degrees = _numbers(
            document["start_pose"], 3, f"{path}: start_pose", "x, y, heading_deg"
        )
        return np.array([x, y, math.radians(degrees)])
    return facing_second(waypoints) if len(waypoints) >= 2 else np.zeros(3)


def _wall(entry: Any, where: str) -> tuple[list[float], list[float]]:
    z = [0.0, WALL_HEIGHT_M]
    if isinstance(entry, Mapping):
        _check_keys(entry, ("from", "to", "z"), where)
        require("from" in entry and "to" in entry, f"{where} must have from: [x, y] and to: [x, y]")
        ends = [v for k in ("from", "to") for v in _numbers(entry[k], 2, f"{where}.{k}", "x, y")]
        if "z" in entry:
            z = _numbers(entry["z"], 2, f"{where}.z", "bottom, top")
    else:
        ends = _numbers(entry, 4, where, "x1, y1, x2, y2")
    require(
        math.dist(ends[:2], ends[2:]) >= 1e-6, f"{where} has no length; give it two different ends"
    )
    require(z[0] < z[1], f"{where} has its top at or below its bottom: {z}")
    return ends, z


def _box(entry: Any, where: str) -> list[tuple[list[float], list[float]]]:
    """Ends, and bottom and top, of the four faces."""
    require(
        isinstance(entry, Mapping),
        f"{where} must be a mapping of {', '.join(_BOX_KEYS)}, got {entry!r}",
    )
    _check_keys(entry, _BOX_KEYS, where)
    values = {"heading_deg": 0.0, "height": WALL_HEIGHT_M, **entry}
    for key in _BOX_KEYS:
        require(key in values, f"{where}.{key} is missing")
    x, y, length, width, heading_deg, height = (
        number(values[key], f"{where}.{key}") for key in _BOX_KEYS
    )
    for key, side in (("length", length), ("width", width), ("height", height)):
        require(side > 0.0, f"{where}.{key} must be positive, got {side:g}")
    corners = box_corners((x, y), (length, width), math.radians(heading_deg))
    return [
        ([*a, *b], [0.0, height])
        for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)
    ]


def _check_keys(entry: Mapping[Any, Any], known: tuple[str, ...], where: str) -> None:
    for key in entry:
        require(key in known, f"{where}: {describe_unknown(key, known)}")


def _list(document: Mapping[str, Any], key: Any, path: Path, prefix: str = "") -> list[Any]:
    value = [] if document.get(key) is None else document[key]
    require(isinstance(value, list), f"{path}: {prefix}{key} must be a list, got {value!r}")
    return list(value)


def _rows(document: Mapping[str, Any], key: Any, width: int, path: Path, prefix: str = "") -> Any:
    names = {2: "x, y", 3: "x, y, z", 4: "x_min, y_min, x_max, y_max"}[width]
    rows = [
        _numbers(entry, width, f"{path}: {prefix}{key}[{i}]", names)
        for i, entry in enumerate(_list(document, key, path, prefix))
    ]
    return np.array(rows, float).reshape(-1, width)


def _numbers(entry: Any, count: int, where: str, names: str) -> list[float]:
    require(
        isinstance(entry, list) and len(entry) == count,
        f"{where} must be {count} numbers {names}, got {entry!r}",
    )
    return [number(value, where) for value in entry]
