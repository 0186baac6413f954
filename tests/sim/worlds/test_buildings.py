"""Builders keep their promises over many seeds; a user's world file is read or refused."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from experiments.runs.experiment import Experiment
from sim.errors import InputError
from sim.sensors.casting import visible
from sim.worlds.floor_plan import make_descriptors
from sim.worlds.world_file import read_world

ROOT = Path(__file__).resolve().parents[3]
OPTIONS = {path.stem for path in (ROOT / "conf" / "world").glob("*.yaml")}
WORLDS = sorted(OPTIONS - {"from_grid"})  # a grid has no tour of its own
CLEARANCE_M = 0.35


def along(path, step_m=0.1):
    pieces = []
    for a, b in pairwise(path):
        n = max(2, int(np.hypot(*(b - a)) / step_m))
        pieces.append(np.linspace(a, b, n))
    return np.concatenate(pieces)


@pytest.mark.slow
@pytest.mark.parametrize("name", WORLDS)
def test_tours_keep_clear_of_walls(name):
    for seed in (0, 1, 50, 1003):
        world = Experiment.compose([f"world={name}", f"seed={seed}"]).world()
        step = 0.1 if len(world.walls) < 700 else 0.5
        least = min(world.clearance_m(p) for p in along(world.waypoints, step))
        assert least >= CLEARANCE_M, f"seed {seed}"
        way = world.waypoints[1] - world.waypoints[0]
        assert world.start_pose[2] == pytest.approx(np.arctan2(way[1], way[0]))
        assert np.allclose(world.start_pose[:2], world.waypoints[0])


def test_office_is_the_building_asked_for():
    seen = set()
    for seed in range(3):
        world = Experiment.compose(["world=office", f"seed={seed}"]).world()
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


def test_every_place_is_passed():
    """The tour comes through each kind of place that a world names."""
    for name in ("room", "rooms", "gil2008", "corridor", "office", "streets", "campus"):
        world = Experiment.compose([f"world={name}", "seed=6"]).world()
        passed = {str(n) for n in world.place_of(along(world.waypoints))} - {""}
        assert passed == set(world.places), name
    corridor = Experiment.compose(["world=corridor"]).world()
    x1, _, x2, _ = corridor.places["corridor_bare"][0]
    assert x2 - x1 >= 20.0


@pytest.mark.parametrize("name", ["office", "rooms", "gil2008", "room"])
def test_a_robot_gets_into_every_room(name):
    """Flood the floor with discs of a robot's size from the start; each room is mostly wet."""
    cell_m, radius_m = 0.1, 0.3
    for seed in range(3, 8):
        world = Experiment.compose([f"world={name}", f"seed={seed}"]).world()
        low, size = world.bounds_m[:2], world.bounds_m[2:] - world.bounds_m[:2]
        open_floor = np.ones(np.ceil(size / cell_m).astype(int) + 1, bool)
        for wall in world.walls:
            at = np.rint((along([wall[:2], wall[2:]], 0.05) - low) / cell_m).astype(int)
            open_floor[tuple(at.T)] = False
        wide = ndimage.distance_transform_edt(open_floor) * cell_m >= radius_m
        pools, _ = ndimage.label(wide)
        first = tuple(np.rint((world.start_pose[:2] - low) / cell_m).astype(int))
        wet = pools == pools[first]
        for x1, y1, x2, y2 in (world.places["room"] - [*low, *low]) / cell_m:
            share = wet[int(x1) : int(x2), int(y1) : int(y2)].mean()
            assert share > 0.4, f"seed {seed}, room at {x1 * cell_m:.1f}, {y1 * cell_m:.1f}"


@pytest.mark.parametrize("name", ["room", "rooms", "gil2008", "corridor", "office", "boxes"])
def test_faces_neither_cross_nor_coincide(name):
    for seed in (0, 2, 3):
        walls = Experiment.compose([f"world={name}", f"seed={seed}"]).world().walls
        start, way = walls[:, :2], walls[:, 2:] - walls[:, :2]
        for i in range(len(walls) - 1):
            p, r, q, s = start[i], way[i], start[i + 1 :], way[i + 1 :]
            parallel = np.abs(_cross(r, s)) < 1e-9
            with np.errstate(divide="ignore", invalid="ignore"):
                t, u = _cross(q - p, s) / _cross(r, s), _cross(q - p, r) / _cross(r, s)
            within = (t > 1e-6) & (t < 1 - 1e-6) & (u > 1e-6) & (u < 1 - 1e-6)
            assert not np.any(~parallel & within), f"seed {seed}: face {i} is crossed"
            shares = np.stack([(q - p) @ r, (q + s - p) @ r]) / (r @ r)
            overlap = np.minimum(shares.max(axis=0), 1) - np.maximum(shares.min(axis=0), 0)
            same_line = parallel & (np.abs(_cross(q - p, r)) < 1e-6 * np.hypot(*r))
            assert not np.any(same_line & (overlap > 1e-6)), f"seed {seed}: face {i} is drawn twice"


@pytest.mark.parametrize("seed", [965284705, 929370195])
def test_objects_that_chance_leaves_no_room_are_placed_again(seed):
    world = Experiment.compose(["world=clutter", f"seed={seed}"]).world()
    assert world.name == "clutter"


def _cross(a, b):
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


@pytest.mark.parametrize(
    ("overrides", "faces", "message"),
    [
        (["world=boxes", "world.n_boxes=30"], 4 + 30 * 4, "fit"),
        (["world=room", "world.n_objects=4"], 4 + 4 * 4, "fit"),
        (["world=boxes", "world.n_boxes=50", "world.side_m=6"], None, r"of 50 objects fit"),
        (["world=office", "world.rooms_visited=30"], None, "rooms_visited must lie in"),
        (["world=office", "world.corridor_m=9"], None, "corridor_m must lie between"),
        (["world=corridor", "world.curve_radius_m=1"], None, "curve_radius_m is too small"),
        (["world=room", "world.n_landmarks=-1"], None, "n_landmarks must be from zero"),
        (["world=room", "world.look_alike_share=2"], None, r"look_alike_share must lie in"),
    ],
)
def test_as_many_objects_as_asked_for_or_a_refusal(overrides, faces, message):
    if faces is None:
        with pytest.raises(InputError, match=message):
            Experiment.compose(overrides).world()
    else:
        assert len(Experiment.compose(overrides).world().walls) == faces


def _inside(points, rectangle):
    return np.all((points >= rectangle[:2]) & (points <= rectangle[2:]), axis=1)


def test_office_rooms_are_closed_but_for_a_door():
    world = Experiment.compose(["world=office", "seed=4"]).world()
    step = 0.02
    for x1, y1, x2, y2 in world.places["room"]:
        rim = along(np.array([[x1, y1], [x2, y1], [x2, y2], [x1, y2], [x1, y1]]), step)
        open_m = step * sum(_distances(world.walls, p).min() > 1e-6 for p in rim)
        assert 0.9 <= open_m <= 1.25


def test_office_rooms_are_furnished_and_differ():
    world = Experiment.compose(["world=office", "seed=5"]).world()
    middle = (world.walls[:, :2] + world.walls[:, 2:]) / 2
    low = world.wall_z_m[:, 1] < 2.0
    views = []
    for room in world.places["room"]:
        inside = _inside(middle, room) & low
        assert inside.sum() >= 4 * 2, "at least two pieces of furniture a room"
        views.append(np.sort(np.hypot(*(middle[inside] - room[:2]).T)).round(3).tobytes())
    assert len(set(views)) == len(views)


def test_the_bare_corridor_is_bare():
    world = Experiment.compose(["world=office", "seed=2"]).world()
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
    world = Experiment.compose(["world=gil2008", "seed=0"]).world()
    assert len(world.landmarks) == 500
    gaps = np.array([world.clearance_m(p[:2]) for p in world.landmarks])
    assert np.all(gaps < 0.0101)
    assert np.mean(gaps > 0.0099) > 0.97  # a few lie beside another face as well
    assert np.all((world.landmarks[:, 2] >= 0.2) & (world.landmarks[:, 2] <= 2.2))


@pytest.mark.parametrize(("name", "share"), [("room", 0.9), ("corridor", 0.9), ("gil2008", 0.85)])
def test_landmarks_face_the_floor(name, share):
    """Most landmarks are in sight from somewhere on the tour: none is behind an outer wall."""
    world = Experiment.compose([f"world={name}", "seed=1"]).world()
    seen = np.zeros(len(world.landmarks), bool)
    for point in along(world.waypoints, 0.5):
        hidden = ~seen
        seen[hidden] = visible(world, [*point, 0.5], world.landmarks[hidden])
    assert seen.mean() > share


def test_landmarks_are_on_walls_and_objects_by_their_shares():
    world = Experiment.compose(["world=gil2008", "seed=1", "world.on_walls_share=0.6"]).world()
    low = world.wall_z_m[:, 1] < 2.5
    rows = [int(np.argmin(_distances(world.walls, p[:2]))) for p in world.landmarks]
    assert np.mean(~low[rows]) == pytest.approx(0.6, abs=0.01)
    assert np.all(world.landmarks[:, 2] < world.wall_z_m[rows, 1])


def _distances(walls, point):
    start, way = walls[:, :2], walls[:, 2:] - walls[:, :2]
    share = np.clip(np.sum((point - start) * way, axis=1) / np.sum(way**2, axis=1), 0, 1)
    return np.hypot(*(point - start - share[:, None] * way).T)


def test_users_world_file():
    world = read_world(ROOT / "docs" / "examples" / "my_world.yaml")
    assert (len(world.walls), len(world.landmarks)) == (13, 2)
    assert world.wall_z_m[4].tolist() == [0.0, 2.0]
    corners = world.walls[5:9, :2]
    assert np.hypot(*(corners - [2.0, 3.2]).T) == pytest.approx(np.full(4, np.hypot(0.5, 0.25)))


def test_numbers_without_a_point_are_numbers(tmp_path):
    path = tmp_path / "w.yaml"
    path.write_text("walls: [[0, 0, 1e1, 0]]\n")
    assert read_world(path).walls.tolist() == [[0.0, 0.0, 10.0, 0.0]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("walls: [[0, 0, 1]]", r"walls\[0\] must be 4 numbers x1, y1, x2, y2, got \[0, 0, 1\]"),
        ("walls: [[0, 0, 1, .nan]]", r"walls\[0\] must be a finite number, got nan"),
        ("walls: [[0, 0, 1, one]]", r"walls\[0\] .*, got 'one'"),
        ("walls: [[1, 2, 1, 2]]", r"walls\[0\] has no length"),
        ("walls: [{from: [0, 0], to: [1, 0], z: [2, 1]}]", "top at or below"),
        ("walls: [{from: [0, 0], too: [1, 0]}]", "unknown key too"),
        ("wals: []", "unknown key wals"),
        ("boxes: [{x: 0, y: 0, length: -1, width: 1}]", r"boxes\[0\]\.length must be positive"),
        ("boxes: [{x: 0, y: 0, width: 1}]", r"boxes\[0\]\.length is missing"),
        ("walls: {a: 1}", "walls must be a list"),
        ("walls: [[0, 0", r"w\.yaml:\d+: not valid YAML"),
        ("just text", "must hold keys"),
        ("places: {room: [[0, 0, 1]]}", r"places\.room\[0\] must be 4 numbers"),
        ("places: {room: [[0, 0, 1, 0]]}", r"places\.room\[0\] must have x_min < x_max"),
        (
            "walls: [[1, -1, 1, 1]]\nwaypoints: [[0, 0], [0.5, 0], [2, 0]]",
            r"waypoints\[1\] to waypoints\[2\] runs through a wall",
        ),
        ("landmarks: [[0, 0, true]]", r"landmarks\[0\] .*, got True"),
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
