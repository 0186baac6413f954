"""The routes of maximo2024: their printed sizes, their descriptors, and reordered recordings."""

import gzip

import numpy as np
import pytest

from estimators.descriptors import retrieval
from experiments.papers.maximo2024 import places
from experiments.papers.maximo2024.places import GEOMETRIES, OXFORD, UMH, place_world
from experiments.papers.maximo2024.settings import POSITIONS
from experiments.runs.experiment import Experiment
from sim.errors import InputError


def measured(world):
    nodes, taken = world.known_map.positions_m, world.recording.truth.poses[:, :2]
    offsets = np.hypot(*(taken[:, None] - nodes[None]).transpose(2, 0, 1))
    steps = [np.hypot(*np.diff(p, axis=0).T) for p in (nodes, taken)]
    return steps[0], steps[1], offsets


@pytest.mark.parametrize("name", GEOMETRIES)
def test_generated_routes_have_the_printed_sizes(name):
    geometry = GEOMETRIES[name]
    parts = [measured(place_world(geometry, seed)) for seed in range(4)]
    spacing = np.concatenate([p[0] for p in parts])
    nearest = np.concatenate([p[2].min(axis=1) for p in parts])
    assert len(parts[0][0]) == geometry.n_nodes - 1
    assert spacing.mean() == pytest.approx(geometry.spacing_m, rel=0.02)
    assert spacing.std() == pytest.approx(geometry.spacing_sd_m, rel=0.1)
    assert nearest.mean() == pytest.approx(geometry.offset_m, rel=0.1)
    assert nearest.std() == pytest.approx(geometry.offset_sd_m, rel=0.15)
    between = np.concatenate([p[1] for p in parts])
    assert between.mean() == pytest.approx(geometry.spacing_m, rel=0.03)


def test_the_real_oxford_positions():
    if not POSITIONS.exists():
        pytest.skip("the positions of RobotCar are not shipped; see docs for where they go")
    nodes = places.oxford_positions(POSITIONS)
    assert nodes.shape == (397, 2)
    steps = np.hypot(*np.diff(nodes, axis=0).T)
    assert steps.mean() == pytest.approx(21.45, abs=0.01)
    assert steps.std() == pytest.approx(3.38, abs=0.01)
    nearest = measured(place_world(OXFORD, 0, nodes))[2].min(axis=1)
    assert nearest.mean() == pytest.approx(10.09, rel=0.15)


def test_a_wrong_positions_file_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        places.oxford_positions(tmp_path / "none.gz")
    path = tmp_path / "positions.csv.gz"
    path.write_bytes(gzip.compress(b"a,b\n1,2\n"))
    with pytest.raises(InputError, match="not the Oxford positions"):
        places.oxford_positions(path)
    path.write_text("no archive")
    with pytest.raises(InputError, match="not the Oxford positions"):
        places.oxford_positions(path)


def test_descriptors_are_unit_vectors_found_again_by_place():
    world = place_world(UMH, 2)
    features = world.known_map.descriptors
    np.testing.assert_allclose(np.linalg.norm(features, axis=1), 1.0, atol=1e-5)
    taken = world.recording.log("place")["descriptor"]
    distances = np.linalg.norm(taken[:, None] - features[None], axis=2)
    offsets = measured(world)[2]
    assert retrieval(distances, offsets, 1.5 * UMH.spacing_m)["recall_at_1"] > 0.95
    again, other = place_world(UMH, 2), place_world(UMH, 3)
    np.testing.assert_array_equal(again.known_map.descriptors, features)
    assert not np.array_equal(other.known_map.descriptors, features)


def test_resequenced_recordings_move_as_the_wheels_did():
    recording = place_world(UMH, 0).recording
    rows = np.concatenate([np.arange(10, 20), np.arange(60, 70)])
    cut = places.resequenced(recording, rows)
    frames, whole = list(cut.frames()), list(recording.frames())
    for i, row in enumerate(rows):
        np.testing.assert_array_equal(
            frames[i].readings["place"]["descriptor"], whole[row].readings["place"]["descriptor"]
        )
        if i:
            np.testing.assert_allclose(
                frames[i].wheel_increments_m, whole[row].wheel_increments_m, atol=1e-9
            )
    np.testing.assert_allclose(cut.truth.poses, recording.truth.poses[rows], atol=1e-9)
    np.testing.assert_allclose(np.diff(cut.frame_stamps), UMH.interval_s)


def test_wheels_record_the_distance_travelled():
    recording = place_world(UMH, 0).recording
    travel = np.diff(recording.wheels.position_m.mean(axis=1))
    steps = np.hypot(*np.diff(recording.truth.poses[:, :2], axis=0).T)
    np.testing.assert_allclose(travel, steps, atol=0.1)


@pytest.mark.parametrize("study", ["oxford", "umh"])
def test_studies_compose_to_a_map_and_queries(study):
    experiment = Experiment.compose([f"study=maximo2024_{study}"])
    recording = experiment.recording()
    known = experiment.prior(recording).map
    assert len(known) == len(recording.frame_stamps) == GEOMETRIES[study].n_nodes
    with pytest.raises(InputError, match="geometry"):
        places.route_map(experiment.config, "rome")
    with pytest.raises(InputError, match="no such file"):
        places.route_map(experiment.config, "oxford", "nowhere.csv.gz")


def test_ones_own_arrays_run_from_one_yaml(tmp_path):
    world = place_world(UMH, 0)
    np.save(tmp_path / "map_positions.npy", world.known_map.positions_m)
    np.save(tmp_path / "map_descriptors.npy", world.known_map.descriptors)
    np.save(tmp_path / "positions.npy", world.recording.truth.poses[:, :2])
    np.save(tmp_path / "descriptors.npy", world.recording.log("place")["descriptor"])
    experiment = Experiment.compose(["study=maximo2024_own", f"data={tmp_path}"])
    recording = experiment.recording()
    known = experiment.prior(recording).map
    np.testing.assert_array_equal(known.descriptors, world.known_map.descriptors)
    np.testing.assert_allclose(recording.truth.poses[:, :2], world.recording.truth.poses[:, :2])
    np.save(tmp_path / "descriptors.npy", np.ones((3, 512)))
    with pytest.raises(InputError, match="as many descriptors"):
        experiment.recording()
