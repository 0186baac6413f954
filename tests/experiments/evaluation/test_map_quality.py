"""Maps of laser points: true poses give true maps, and wrong poses show."""

import dataclasses
import math

import numpy as np
import pytest

from experiments.evaluation.map_quality import (
    closure_errors,
    landmark_errors,
    map_points,
    mean_map_entropy,
    wall_distances_m,
)
from sim import se2
from sim.errors import InputError
from tests.fixtures.fakes import circle, estimate


def test_the_true_map_lies_on_the_walls_and_a_false_one_does_not():
    recording = circle()
    true = map_points(recording, estimate(recording), every_s=0.5, every_beam=3)
    world = recording.truth.world
    distances = wall_distances_m(true, world)
    assert distances.mean() == pytest.approx(0.01 * np.sqrt(2 / np.pi), rel=0.3)  # of the noise
    drift = np.linspace(0.0, 0.3, len(recording.frame_stamps))
    means = recording.truth_at(recording.frame_stamps) + drift[:, None] * [1.0, 0.0, 0.1]
    false = map_points(recording, estimate(recording, means), every_s=0.5, every_beam=3)
    assert len(false) == len(true)
    assert wall_distances_m(false, world).mean() > 5.0 * distances.mean()
    rng = np.random.default_rng(0)
    assert mean_map_entropy(false, rng) > mean_map_entropy(true, rng) + 0.3


def test_distances_are_those_to_segments():
    world = dataclasses.replace(
        circle().truth.world, walls=np.array([[0.0, 0.0, 2.0, 0.0]]), wall_z_m=np.array([[0, 2.5]])
    )
    points = np.array([[1.0, 0.5], [-3.0, 4.0], [2.0, -0.1], [0.3, 0.0]])
    np.testing.assert_allclose(wall_distances_m(points, world), [0.5, 5.0, 0.1, 0.0], atol=1e-12)


def test_entropy_is_that_of_a_gaussian():
    rng = np.random.default_rng(1)
    points = 0.02 * rng.standard_normal((400, 2))
    expected = np.log(2 * np.pi * np.e * (0.02**2 + 1e-6))
    assert mean_map_entropy(points, rng) == pytest.approx(expected, abs=0.1)
    assert np.isnan(mean_map_entropy(np.array([[0.0, 0.0], [9.0, 9.0]]), rng))


def test_a_recording_without_a_laser_is_refused():
    with pytest.raises(InputError, match="laser"):
        map_points(circle().without("laser"), estimate(circle()))


def test_landmarks_are_compared_with_those_they_were_started_by():
    recording = circle()
    true = recording.truth.world.landmarks
    turned = se2.transform(np.array([1.0, 2.0, 0.3]), true[:, :2])
    made = {"landmarks": np.column_stack([turned, true[:, 2] + 0.1]), "ids": np.arange(len(true))}
    found = landmark_errors(recording, made)
    assert found["n_landmarks"] == len(true)
    assert found["map_aligned_rmse_m"] == pytest.approx(0.1)
    shift = np.linalg.norm(made["landmarks"] - true, axis=1)
    assert found["map_rmse_m"] == pytest.approx(np.sqrt(np.mean(shift**2)))
    seen = recording.truth.readings["stereo"]["true_ids"]
    origins = np.array([0, len(seen) - 1])  # without ids, by the observation that started each
    guessed = {"landmarks": true[seen[origins]] + [0.0, 0.0, 0.2], "origins": origins}
    assert landmark_errors(recording, guessed)["map_rmse_m"] == pytest.approx(0.2)
    assert landmark_errors(recording, None) == {}
    assert landmark_errors(dataclasses.replace(recording, truth=None), made) == {}


def test_a_closure_is_false_if_it_is_off_by_more_than_it_claims_to_know():
    drive, k = circle(n_frames=700), 34  # nodes of a lap, and a little
    stamps = drive.frame_stamps[::10]
    true = drive.truth_at(stamps)
    motion = se2.between(true[2], true[2 + k])
    off = np.array([0.5, 0.0, 0.0])
    sure, loose = np.diag([1e-4, 1e-4, 1e-6]), np.diag([100.0, 1e-4, 1e-6])
    graph = {
        "stamps": np.r_[math.nan, stamps[1:]],
        "closures": np.tile([2, 2 + k], (3, 1)),
        "motions": motion + np.outer([0.0, 1.0, 1.0], off),
        "covariances": np.array([sure, sure, loose]),
    }
    found = closure_errors(drive, graph)
    assert found["closures"] == 3
    assert found["false_closures"] == 1
    assert 0 < found["revisits"] <= len(stamps) - k + 1
    assert 0.0 < found["revisits_closed"] < 1.0
    none = {name: values[:0] for name, values in graph.items() if name != "stamps"}
    assert closure_errors(drive, graph | none)["revisits_closed"] == 0.0
    early = drive.truth.stamps < stamps[2 + k] - 0.5  # the truth ends before the closures do
    truth = dataclasses.replace(
        drive.truth, stamps=drive.truth.stamps[early], poses=drive.truth.poses[early]
    )
    unknown = closure_errors(dataclasses.replace(drive, truth=truth), graph)
    assert unknown["false_closures"] == 0
    assert "revisits_closed" not in unknown or unknown["revisits"] > 0
    assert closure_errors(drive, None) == closure_errors(drive, {"closures": []}) == {}
