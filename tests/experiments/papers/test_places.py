"""The routes of maximo2024: their printed sizes, their descriptors, and reordered recordings."""

import gzip

import numpy as np
import pytest

from estimators.topological.descriptors import retrieval
from experiments.papers.maximo2024 import places
from experiments.papers.maximo2024.places import GEOMETRIES, OXFORD, UMH, place_world
from experiments.papers.maximo2024.settings import POSITIONS
from experiments.runs.evaluate import evaluate
from experiments.runs.experiment import Experiment
from sim.errors import InputError
from sim.team import Team
from tests.fixtures import fakes


def measured(world):
    nodes, taken = world.known_map.positions_m, world.recording.truth.poses[:, :2]
    offsets = np.hypot(*(taken[:, None] - nodes[None]).transpose(2, 0, 1))
    steps = [np.hypot(*np.diff(p, axis=0).T) for p in (nodes, taken)]
    return steps[0], steps[1], offsets


@pytest.mark.parametrize("offsets", ["along", "plane"])
@pytest.mark.parametrize("name", GEOMETRIES)
def test_generated_routes_have_the_printed_sizes(name, offsets):
    geometry = GEOMETRIES[name]
    parts = [measured(place_world(geometry, seed, offsets=offsets)) for seed in range(4)]
    spacing = np.concatenate([p[0] for p in parts])
    nearest = np.concatenate([p[2].min(axis=1) for p in parts])
    assert len(parts[0][0]) == geometry.n_nodes - 1
    assert spacing.mean() == pytest.approx(geometry.spacing_m, rel=0.02)
    assert spacing.std() == pytest.approx(geometry.spacing_sd_m, rel=0.1)
    assert nearest.mean() == pytest.approx(geometry.offset_m, rel=0.1)
    if (name, offsets) == ("oxford", "along"):  # the printed one does not fit between nodes
        assert nearest.std() < 2.0
    else:
        assert nearest.std() == pytest.approx(geometry.offset_sd_m, rel=0.2)
    between = np.concatenate([p[1] for p in parts])
    assert between.mean() == pytest.approx(geometry.spacing_m, rel=0.03)


@pytest.mark.parametrize("name", GEOMETRIES)
def test_queries_lie_on_the_way_to_the_next_node(name):
    world = place_world(GEOMETRIES[name], 1)
    nodes, taken = world.known_map.positions_m[:-1], world.recording.truth.poses[:-1, :2]
    way = np.diff(world.known_map.positions_m, axis=0)
    lengths = np.hypot(*way.T)
    along = np.sum((taken - nodes) * way, axis=1) / lengths**2
    across = np.hypot(*(taken - nodes - along[:, None] * way).T)
    np.testing.assert_allclose(across, 0.0, atol=1e-9)
    assert np.all((along > 0.0) & (along < 1.0))


def test_offsets_are_checked():
    with pytest.raises(InputError, match="offsets must be along or plane, got 'odd'"):
        place_world(UMH, 0, offsets="odd")


needs_positions = pytest.mark.skipif(
    not POSITIONS.exists(), reason="the positions of RobotCar are not part of the project"
)


@needs_positions
def test_any_oxford_run_is_a_map():
    runs = places.oxford_runs(POSITIONS)
    assert len(runs) == 15
    assert places.OXFORD_RUN in runs
    sizes = [len(places.oxford_positions(POSITIONS, run)) for run in runs]
    assert (min(sizes), max(sizes)) == (377, 445)
    lines = ["study=maximo2024/oxford", f"positions='{POSITIONS}'", f"positions_run={runs[0]}"]
    experiment = Experiment.compose(lines)
    recording = experiment.recording()
    assert len(experiment.prior(recording).map) == len(recording.frame_stamps) == sizes[0]
    with pytest.raises(InputError, match="no database positions of run '2014'; it holds 2014-1"):
        places.oxford_positions(POSITIONS, "2014")


@needs_positions
def test_the_real_oxford_positions():
    nodes = places.oxford_positions(POSITIONS)
    assert nodes.shape == (397, 2)
    steps = np.hypot(*np.diff(nodes, axis=0).T)
    assert steps.mean() == pytest.approx(21.45, abs=0.01)
    assert steps.std() == pytest.approx(3.38, abs=0.01)
    nearest = measured(place_world(OXFORD, 0, nodes))[2].min(axis=1)
    assert nearest.mean() == pytest.approx(10.09, rel=0.15)


def test_a_robot_may_start_anywhere_and_stop_early():
    lines = ["study=maximo2024/umh", "recording.first_query=100", "recording.n_queries=5"]
    part = Experiment.compose(lines).recording()
    whole = Experiment.compose(lines[:1]).recording()
    poses = part.truth_at(part.frame_stamps)
    np.testing.assert_allclose(poses, whole.truth.poses[100:105], atol=1e-9)
    for wrong in ("recording.first_query=135", "recording.n_queries=137", "recording.n_queries=0"):
        with pytest.raises(InputError, match=wrong.partition("=")[0]):
            Experiment.compose([lines[0], wrong]).recording()


def test_a_wrong_positions_file_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        places.oxford_positions(tmp_path / "none.gz")
    path = tmp_path / "positions.csv.gz"
    path.write_bytes(gzip.compress(b"set,run_name,northing_m,easting_m\ndatabase,a,1,inf\n"))
    with pytest.raises(InputError, match="a position is not finite"):
        places.oxford_positions(path)
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
    cut = places.resequence(recording, rows)
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
    experiment = Experiment.compose([f"study=maximo2024/{study}"])
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
    experiment = Experiment.compose(["study=maximo2024/own", f"data={tmp_path}"])
    recording = experiment.recording()
    known = experiment.prior(recording).map
    np.testing.assert_array_equal(known.descriptors, world.known_map.descriptors)
    np.testing.assert_allclose(recording.truth.poses[:, :2], world.recording.truth.poses[:, :2])
    np.save(tmp_path / "descriptors.npy", np.ones((3, 512)))
    with pytest.raises(InputError, match="as many descriptors"):
        experiment.recording()


def test_a_network_of_ones_own_describes_clouds():
    lines = ["study=maximo2024/network", "network._target_=tests.fixtures.fakes.outline"]
    experiment = Experiment.compose([*lines, "simulation.physics=kinematic", "route.distance_m=20"])
    recording = experiment.recording()
    seen = recording.log("place")["descriptor"]
    points = recording.sensors["lidar3d"].points_in_sensor(recording.log("lidar3d")["ranges_m"][3])
    np.testing.assert_allclose(seen[3], fakes.outline(points), rtol=1e-6)
    assert experiment.prior(recording).map.descriptors.shape[1] == 16
    (row,) = evaluate(experiment, lambda: Team((recording,)))
    assert row["status"] == "ok"
    assert row["ate_mean_m"] < 10.0
    for name in ("outline", "Outline"):  # a function, and a class, with a setting
        network = {"_target_": f"tests.fixtures.fakes.{name}", "n": 24}
        other = places.described_run(experiment.config, network).log("place")["descriptor"]
        np.testing.assert_allclose(other[3], fakes.outline(points, 24), rtol=1e-6)


def test_a_network_that_answers_badly_is_named():
    lines = ["study=maximo2024/network", "network._target_=numpy.atleast_2d"]
    short = ["simulation.physics=kinematic", "route.distance_m=5"]
    with pytest.raises(InputError, match=r"numpy.atleast_2d must return finite numbers of shape"):
        Experiment.compose([*lines, *short]).recording()
