"""Global descriptors of clouds, against their definitions and by what they are for."""

import numpy as np
import pytest

from estimators.topological import descriptors
from estimators.topological.descriptors import KINDS, N_RINGS, N_SECTORS
from sim.errors import InputError
from sim.sensors import Lidar3D
from sim.sensors.casting import cast_lidar
from sim.worlds.buildings import campus

LIDAR = Lidar3D()


@pytest.fixture(scope="module")
def world():
    return campus(
        rng=np.random.default_rng(3),
        n_x=2,
        n_y=1,
        block_m=80.0,
        street_m=16.0,
        trees_per_block=10,
    )


def cloud(world, pose, seed=0):
    return LIDAR.measure(cast_lidar(world, LIDAR, pose), np.random.default_rng(seed))


def places(world, offset_m=0.0, turn_rad=0.0, seed=0, n=30):
    rng = np.random.default_rng(seed)
    rows = np.linspace(0, len(world.waypoints) - 2, n).astype(int)
    positions = world.waypoints[rows] + offset_m * rng.uniform(-1.0, 1.0, (n, 2))
    clouds = [cloud(world, [*p, turn_rad], seed + i) for i, p in enumerate(positions)]
    return positions, clouds


def test_polar_heights_are_the_highest_points():
    points = np.array([[10.0, 1.0, 2.0], [10.1, 1.0, 5.0], [-30.0, -0.1, 1.0], [100.0, 0.0, 9.0]])
    heights = descriptors.polar_heights(points, 1.5)
    assert heights[2, 30] == 6.5  # 4 m rings, 6 degree sectors from -pi
    assert heights[7, 0] == 2.5
    assert np.count_nonzero(heights) == 2  # what is beyond 80 m is left out


def test_scan_context_distance_is_the_published_one():
    rng = np.random.default_rng(0)
    contexts = rng.random((4, N_RINGS, N_SECTORS)) * (rng.random((4, 1, N_SECTORS)) > 0.2)
    unit = contexts / np.maximum(np.linalg.norm(contexts, axis=1, keepdims=True), 1e-12)
    rows = unit.reshape(4, -1).astype(np.float32)
    found = descriptors.scan_context_distances(rows[0], rows)
    for i in range(4):
        best = 2.0
        for shift in range(N_SECTORS):
            mine = np.roll(contexts[0], -shift, axis=1)
            cosines = [
                mine[:, c]
                @ contexts[i][:, c]
                / (np.linalg.norm(mine[:, c]) * np.linalg.norm(contexts[i][:, c]))
                for c in range(N_SECTORS)
                if mine[:, c].any() and contexts[i][:, c].any()
            ]
            best = min(best, 1.0 - np.mean(cosines))
        assert found[i] == pytest.approx(best, abs=1e-5)
    assert found[0] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("name", KINDS)
def test_places_are_found_again_whatever_the_heading(world, name):
    kind = KINDS[name]
    nodes, clouds = places(world)
    database = np.array([kind.describe(LIDAR, c) for c in clouds])
    assert database.dtype == np.float32
    here, clouds = places(world, offset_m=1.0, turn_rad=2.0, seed=50)
    distances = np.array([kind.distances(kind.describe(LIDAR, c), database) for c in clouds])
    offsets = np.hypot(*(here[:, None] - nodes[None]).transpose(2, 0, 1))
    quality = descriptors.retrieval(distances, offsets, 5.0)
    assert quality["queries"] == 30
    assert quality["recall_at_1"] >= (0.7 if name == "ring_key" else 0.85)
    if name != "ring_key":
        shuffled = np.random.default_rng(0).permutation(distances.T).T
        assert descriptors.retrieval(shuffled, offsets, 5.0)["recall_at_1"] < 0.3


@pytest.mark.parametrize("name", KINDS)
def test_an_empty_cloud_has_a_finite_description(name):
    row = KINDS[name].describe(LIDAR, np.full((16, 720), np.inf, np.float32))
    assert np.isfinite(row).all()
    assert np.isfinite(KINDS[name].distances(row, np.stack([row, row]))).all()


def test_retrieval_counts_what_place_recognition_counts():
    distances = np.array([[0.1, 0.2, 0.3], [0.3, 0.1, 0.2], [0.1, 0.2, 0.3]])
    offsets = np.array([[1.0, 50.0, 90.0], [2.0, 60.0, 70.0], [80.0, 80.0, 80.0]])
    found = descriptors.retrieval(distances, offsets, 5.0)
    assert found == {"recall_at_1": 0.5, "recall_at_1_percent": 0.5, "queries": 2.0}
    many = np.tile(np.arange(300.0), (1, 1))
    near = np.full((1, 300), 99.0)
    near[0, 2] = 0.0
    assert descriptors.retrieval(many, near, 5.0)["recall_at_1_percent"] == 1.0
    assert descriptors.retrieval(many, near, 5.0)["recall_at_1"] == 0.0
    assert np.isnan(descriptors.retrieval(distances, offsets, 0.5)["recall_at_1"])


def test_an_unknown_kind_is_named():
    with pytest.raises(InputError, match="scan_context"):
        descriptors.kind("sift")
