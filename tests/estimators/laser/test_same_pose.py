"""Scans of one pose: the identity without noise, and on average with it."""

import numpy as np
import pytest

from estimators.laser.icp import Rules, prepare, register
from experiments.bench.icp import places
from experiments.evaluation.registration_errors import same_pose_errors
from experiments.runs.seeds import stream

BARS = np.array([5e-5, 5e-5, 15e-6])  # m, m, rad
NEIGHBOURS = pytest.mark.parametrize("neighbours", [6, 12, 20])


@pytest.fixture(scope="module")
def scenes():
    return list(places(6))


def errors_of(scenes, n_pairs, rules):
    """Errors (P, n_pairs, 2, 3) of noisy pairs at each place, each way."""
    return np.array(
        [
            same_pose_errors(scan, laser, stream(k, "sensors"), n_pairs, rules=rules)
            for k, (laser, scan) in enumerate(scenes)
        ]
    )


def biases(errors):
    """Means (P, 3) of errors (P, n, 3), and their standard errors (P, 3)."""
    return errors.mean(axis=1), errors.std(axis=1, ddof=1) / np.sqrt(errors.shape[1])


def exceed(errors):
    """Which biases, by the mean of both ways, are beyond the bars by two standard errors."""
    means, of_means = biases(errors.mean(axis=2))
    return np.abs(means) - 2.0 * of_means > BARS


@NEIGHBOURS
@pytest.mark.parametrize("noise", [False, True])
def test_a_scan_against_itself_is_the_identity(scenes, neighbours, noise):
    off = []
    for k, (laser, scan_m) in enumerate(scenes):
        ranges_m = laser.measure(scan_m, stream(k, "sensors")) if noise else scan_m
        scan = prepare(ranges_m, laser.bearings_rad, laser.max_range_m)
        found, pulled = (
            register(scan, scan, np.zeros(3), metric="point_to_plane", rules=rules)
            for rules in (
                Rules(neighbours=neighbours),
                Rules(neighbours=neighbours, plane="centroid"),
            )
        )
        np.testing.assert_allclose(found.T_target_source, 0.0, atol=1e-12)
        off.append(np.abs(pulled.T_target_source).max())
    assert np.max(off) > 1e-5


def test_noisy_scans_of_one_pose_are_registered_there_on_average(scenes):
    """The same with fewer pairs; the neighbours' centroid pulls by far more than the bars."""
    few = scenes[1::2]
    assert not exceed(errors_of(few, 50, Rules())).any()
    for neighbours in (6, 12, 20):
        pulled = errors_of(few, 20, Rules(neighbours=neighbours, plane="centroid"))
        assert exceed(pulled).any()


@pytest.mark.slow
@NEIGHBOURS
def test_a_thousand_noisy_pairs_at_ten_places(neighbours):
    """One way, all but a mean or two of thirty lie within three standard errors; by both ways the
    bias, of second order in the noise, is below the bars."""
    scenes = list(places())
    errors = errors_of(scenes, 1000, Rules(neighbours=neighbours))
    means, of_means = biases(errors[:, :, 0])
    assert np.sum(np.abs(means) > 3.0 * of_means) <= 2
    assert not exceed(errors).any()
    pulled = errors_of(scenes, 100, Rules(neighbours=neighbours, plane="centroid"))
    assert np.mean(exceed(pulled).any(axis=1)) > 0.5
    means, of_means = biases(pulled[:, :, 0])
    assert np.sum(np.abs(means) > 3.0 * of_means) > 2
