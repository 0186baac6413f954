from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from experiments.build import make_world
from experiments.compose import compose
from sim.errors import InputError
from sim.plan import make_descriptors
from sim.world_file import read_world

ROOT = Path(__file__).resolve().parent.parent
WORLDS = sorted(p.stem for p in (ROOT / "conf" / "world").glob("*.yaml"))
CLEARANCE_M = 0.35


def along(path, step_m=0.1):
    pieces = []
    for a, b in pairwise(path):
        n = max(2, int(np.hypot(*(b - a)) / step_m))
        pieces.append(np.linspace(a, b, n))
    return np.concatenate(pieces)


@pytest.mark.parametrize("name", WORLDS)
def test_tours_keep_clear_of_walls(name):
    for seed in (0, 1, 50, 1003):
        world = make_world(compose([f"world={name}", f"seed={seed}"]))
        step = 0.1 if len(world.walls) < 700 else 0.5
        least = min(world.clearance_m(p) for p in along(world.waypoints, step))
        assert least >= CLEARANCE_M, f"seed {seed}"
        way = world.waypoints[1] - world.waypoints[0]
        assert world.start_pose[2] == pytest.approx(np.arctan2(way[1], way[0]))
        assert np.allclose(world.start_pose[:2], world.waypoints[0])


def test_office_is_the_building_asked_for():
    seen = set()
    for seed in range(3):
        world = make_world(compose(["world=office", f"seed={seed}"]))
        x1, y1, x2, y2 = world.bounds_m
        assert x2 - x1 >= 60
        assert y2 - y1 >= 40
        assert len(world.places["room"]) >= 20
        bare = world.places["corridor_bare"]
        assert np.max(bare[:, 2] - bare[:, 0]) >= 40
        tour = along(world.waypoints)
        assert np.sum(np.hypot(*np.diff(world.waypoints, axis=0).T)) >= 300
        names = world.place_of(tour)
        assert {"corridor_bare", "corridor_objects", "corner", "room"} <= set(names)
        visited = [r for r in world.places["room"] if _inside(tour, r).any()]
        assert len(visited) >= 8
        seen.add(world.walls.tobytes())
    assert len(seen) == 3


def _inside(points, rectangle):
    return np.all((points >= rectangle[:2]) & (points <= rectangle[2:]), axis=1)


def test_office_rooms_are_furnished_and_differ():
    world = make_world(compose(["world=office", "seed=5"]))
    middle = (world.walls[:, :2] + world.walls[:, 2:]) / 2
    low = world.wall_z_m[:, 1] < 2.0
    views = []
    for room in world.places["room"]:
        inside = _inside(middle, room) & low
        assert inside.sum() >= 4 * 2, "at least two pieces of furniture a room"
        views.append(np.sort(np.hypot(*(middle[inside] - room[:2]).T)).round(3).tobytes())
    assert len(set(views)) == len(views)


def test_the_bare_corridor_is_bare():
    world = make_world(compose(["world=office", "seed=2"]))
    x1, y1, x2, y2 = world.places["corridor_bare"][0]
    ends = np.concatenate([world.walls[:, :2], world.walls[:, 2:]])
    assert not _inside(ends, np.array([x1 + 0.01, y1 + 0.01, x2 - 0.01, y2 - 0.01])).any()
    for y in (y1, y2):  # and its sides are whole: no door for 40 m
        side = world.walls[np.all(np.abs(world.walls[:, 1::2] - y) < 1e-6, axis=1)][:, 0::2]
        spans = np.sort(side, axis=1)
        assert np.any((spans[:, 0] <= x1 + 1e-6) & (spans[:, 1] >= x2 - 1e-6))


def test_look_alikes_have_their_share():
    descriptors, alike = make_descriptors(np.random.default_rng(0), 301, 0.3)
    assert alike.sum() == 90
    assert np.linalg.norm(descriptors, axis=1) == pytest.approx(np.ones(301), abs=1e-6)
    _, groups, counts = np.unique(descriptors, axis=0, return_inverse=True, return_counts=True)
    assert np.array_equal(counts[groups.ravel()] > 1, alike)
    unlike = descriptors[~alike] @ descriptors[~alike].T
    assert np.max(unlike - np.eye(len(unlike))) < 0.8


def test_landmarks_stand_proud_of_their_face():
    world = make_world(compose(["world=gil2008", "seed=0"]))
    assert len(world.landmarks) == 500
    gaps = np.array([world.clearance_m(p[:2]) for p in world.landmarks])
    assert np.all(gaps < 0.0101)
    assert np.mean(gaps > 0.0099) > 0.97  # a few lie beside another face as well
    assert np.all((world.landmarks[:, 2] >= 0.2) & (world.landmarks[:, 2] <= 2.2))


def test_users_world_file():
    world = read_world(ROOT / "docs" / "examples" / "my_world.yaml")
    assert (len(world.walls), len(world.landmarks)) == (13, 2)
    assert world.wall_z_m[4].tolist() == [0.0, 2.0]
    corners = world.walls[5:9, :2]
    assert np.hypot(*(corners - [2.0, 3.2]).T) == pytest.approx(np.full(4, np.hypot(0.5, 0.25)))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("walls: [[0, 0, 1]]", r"walls\[0\] must be 4 numbers x1, y1, x2, y2, got \[0, 0, 1\]"),
        ("walls: [[0, 0, 1, .nan]]", r"walls\[0\]: nan is not a finite number"),
        ("walls: [[0, 0, 1, one]]", r"walls\[0\]: 'one' is not"),
        ("walls: [[1, 2, 1, 2]]", r"walls\[0\] has no length"),
        ("walls: [{from: [0, 0], to: [1, 0], z: [2, 1]}]", "top at or below"),
        ("walls: [{from: [0, 0], too: [1, 0]}]", "unknown key 'too'"),
        ("wals: []", "unknown key 'wals'"),
        ("boxes: [{x: 0, y: 0, length: -1, width: 1}]", r"boxes\[0\]\.length must be positive"),
        ("boxes: [{x: 0, y: 0, width: 1}]", r"boxes\[0\]\.length is missing"),
        ("walls: {a: 1}", "walls must be a list"),
        ("walls: [[0, 0", r"w\.yaml:\d+: not valid YAML"),
        ("just text", "must hold keys"),
        ("places: {room: [[0, 0, 1]]}", r"places\.room\[0\] must be 4 numbers"),
        ("!!python/object/apply:os.system ['true']", "not valid YAML"),
    ],
)
def test_malformed_world_files_name_the_entry(tmp_path, text, message):
    path = tmp_path / "w.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_world(path)
    assert "w.yaml" in str(caught.value)
    assert "\n" not in str(caught.value)
