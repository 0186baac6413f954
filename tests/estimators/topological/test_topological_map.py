"""Topological maps: what makes one, what is refused, and what comes back from a file."""

import dataclasses
import re

import numpy as np
import pytest

from estimators.topological import descriptors
from estimators.topological.topological_map import (
    TopologicalMap,
    from_arrays,
    from_files,
    from_recording,
    level_slice,
    load,
    read_array,
    save,
)
from sim import se2
from sim.errors import InputError
from sim.recording import Log, Recording, Truth, WheelLog
from sim.robot.drive import RobotGeometry
from sim.sensors import Lidar3D, PlaceDescriptor
from sim.sensors.casting import cast_lidar
from tests.fixtures.fakes import square_room

LINE = np.column_stack([2.0 * np.arange(6), np.zeros(6)])
FEATURES = np.eye(6, 4)
LIDAR = Lidar3D(n_azimuths=360, sigma_range_m=0.0)


def ring_run(n=41, radius_m=2.5):
    """A circle in the square room with a cloud every few decimetres; the last is at the first."""
    turn = np.linspace(0.0, 2.0 * np.pi, n)
    poses = np.column_stack(
        [radius_m * np.sin(turn), -radius_m * np.cos(turn), np.arctan2(np.sin(turn), np.cos(turn))]
    )
    stamps, world = np.arange(n) / 1.0, square_room()
    clouds = np.stack([cast_lidar(world, LIDAR, pose) for pose in poses]).astype(np.float32)
    half = 0.2
    travel = turn[:, None] * [radius_m + half, radius_m - half]
    return Recording(
        stamps,
        WheelLog(stamps, travel),
        RobotGeometry(0.1, 2 * half),
        {"lidar3d": LIDAR},
        truth=Truth(stamps, poses, world=world),
        logs={"lidar3d": Log.of(LIDAR, stamps, ranges_m=clouds)},
    )


def test_a_route_joins_its_successive_nodes():
    known = from_arrays(LINE, FEATURES)
    assert known.edges.tolist() == [[i, i + 1] for i in range(5)]
    assert known.spacing_m == 2.0
    broken = np.delete(LINE, 2, axis=0)
    assert from_arrays(broken, FEATURES[:5], break_m=3.0).edges.tolist() == [[0, 1], [2, 3], [3, 4]]
    looped = np.array([[0, 0], [2, 0], [4, 0], [4, 2], [2, 2], [0, 2.0]])
    assert [0, 5] in from_arrays(looped, FEATURES, join_m=2.5).edges.tolist()
    assert [0, 5] not in from_arrays(looped, FEATURES, join_m=1.0).edges.tolist()


def test_what_is_no_map_is_refused():
    for positions, features, message in (
        (np.zeros((0, 2)), np.zeros((0, 4)), "at least one node"),
        (LINE, FEATURES[:5], "(6, D)"),
        (LINE, np.zeros((6, 0)), "(6, D)"),
        (np.zeros((6, 3)), FEATURES, "(N, 2)"),
        (np.where(LINE == 4.0, np.nan, LINE), FEATURES, "position 2"),
        (LINE, np.where(FEATURES == 1.0, np.inf, FEATURES), "descriptor 0"),
    ):
        with pytest.raises(InputError, match=re.escape(message)):
            from_arrays(positions, features)
    features = FEATURES.astype(np.float32)
    for edges in ([[0, 6]], [[2, 2]], [[3, 1]], [[-1, 2]]):
        with pytest.raises(InputError, match="edge 0"):
            TopologicalMap(LINE, features, np.array(edges))
    with pytest.raises(InputError, match="unknown descriptor"):
        from_arrays(LINE, FEATURES, descriptor="sift")


def test_one_node_and_duplicates_are_maps():
    assert len(from_arrays(LINE[:1], FEATURES[:1])) == 1
    assert from_arrays(LINE[:1], FEATURES[:1]).spacing_m == 0.0
    twice = from_arrays(np.zeros((6, 2)), FEATURES)
    assert twice.spacing_m == 0.0
    assert len(twice.edges) == 5


def test_a_saved_map_comes_back(tmp_path):
    known = from_recording(ring_run(), "ring_key", 1.0)
    save(known, tmp_path / "map.npz")
    again = load(tmp_path / "map.npz")
    for f in dataclasses.fields(known):
        np.testing.assert_array_equal(getattr(known, f.name), getattr(again, f.name))


def test_a_damaged_or_missing_file_is_told(tmp_path):
    path = tmp_path / "map.npz"
    with pytest.raises(InputError, match="not a topological map"):
        load(path)
    save(from_arrays(LINE, FEATURES), path)
    path.write_bytes(path.read_bytes()[:-80])
    with pytest.raises(InputError, match=r"map\.npz"):
        load(path)
    np.savez(path, positions_m=LINE)
    with pytest.raises(InputError, match="not a topological map"):
        load(path)
    pickled = np.array([{"a": 1}], dtype=object)
    np.savez(path, topological_map=pickled)
    with pytest.raises(InputError, match="not a topological map"):
        load(path)


def test_arrays_of_ones_own(tmp_path):
    np.save(tmp_path / "p.npy", LINE)
    (tmp_path / "d.csv").write_text("\n".join(",".join(map(str, row)) for row in FEATURES))
    known = from_files(str(tmp_path / "p.npy"), str(tmp_path / "d.csv"))
    np.testing.assert_array_equal(known.descriptors, FEATURES)
    assert known.descriptor == ""
    (tmp_path / "h.csv").write_text("x,y\n1,2\n3,4e1\n")
    assert read_array(tmp_path / "h.csv").tolist() == [[1, 2], [3, 40]]
    np.save(tmp_path / "o.npy", np.array([None, 1]), allow_pickle=True)
    for name in ("missing.npy", "o.npy"):
        with pytest.raises(InputError, match=name):
            read_array(tmp_path / name)


def test_a_map_from_a_mapping_run():
    run = ring_run()
    known = from_recording(run, "scan_context", 1.0)
    steps = np.hypot(*np.diff(known.positions_m, axis=0).T)
    assert np.all(steps >= 1.0)
    assert np.all(steps < 1.5)
    assert [0, len(known) - 1] in known.edges.tolist()  # the loop is closed
    rows = [int(np.argmin(np.hypot(*(run.truth.poses[:, :2] - p).T))) for p in known.positions_m]
    np.testing.assert_allclose(known.headings_rad, run.truth.poses[rows, 2])
    np.testing.assert_array_equal(
        known.descriptors[3],
        descriptors.scan_context(LIDAR, run.log("lidar3d")["ranges_m"][rows[3]]),
    )
    # the slice is the planar scan of the walls, 4 m away at most by sqrt 2
    bearings = LIDAR.azimuths_rad
    points = known.slices_m[0][:, None] * np.stack([np.cos(bearings), np.sin(bearings)], axis=1)
    points += known.positions_m[0]
    np.testing.assert_allclose(np.abs(points).max(axis=1), 4.0, atol=1e-4)


def test_a_map_of_place_descriptors():
    run = ring_run()
    sensor = PlaceDescriptor()
    log = Log.of(sensor, run.log("lidar3d").stamps, descriptor=np.eye(41))
    known = from_recording(run.with_log("place", log, sensor), spacing_m=1.0)
    assert known.descriptor == ""
    assert known.descriptors.shape[1] == 41
    assert known.slices_m.size == 0
    with pytest.raises(InputError, match="3D clouds or place"):
        from_recording(run.without("lidar3d"))


def test_the_slice_looks_up_rather_than_down():
    ranges = np.tile(np.arange(16.0)[:, None] + 1.0, (1, 360)).astype(np.float32)
    ring = level_slice(LIDAR, ranges)
    assert ring[0] == pytest.approx(9.0 * np.cos(np.radians(1.0)))


def test_moved():
    T = np.array([3.0, -2.0, 0.7])
    known = from_recording(ring_run(), "ring_key", 1.0)
    moved = known.moved(T)
    back = moved.moved(se2.inverse(T))
    np.testing.assert_allclose(back.positions_m, known.positions_m, atol=1e-12)
    assert np.hypot(*(moved.positions_m[1] - moved.positions_m[0])) == pytest.approx(
        np.hypot(*(known.positions_m[1] - known.positions_m[0]))
    )
