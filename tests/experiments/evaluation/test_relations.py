import math

import numpy as np
import pytest

from experiments.evaluation.relations import relation_errors
from experiments.evaluation.time_sync import aligned_ate_m, interpolate, nearest_rows
from sim import se2
from sim.errors import InputError
from sim.formats.rawseeds import read_trajectory
from sim.formats.relations import Relations, read_relations
from sim.formats.text import read_members, split_words
from tests.fixtures.log_samples import DATA

needs_data = pytest.mark.skipif(not DATA.exists(), reason="no real logs here")


def walk(seed=0, n=40):
    rng = np.random.default_rng(seed)
    stamps = np.cumsum(rng.uniform(0.5, 1.5, n))
    poses = np.cumsum(rng.normal(0.0, 0.3, (n, 3)), axis=0)
    poses[:, 2] = se2.wrap(poses[:, 2])
    return stamps, poses


def test_nearest_is_the_nearest():
    stamps = np.array([0.0, 1.0, 2.5])
    wanted = np.array([-1.0, 0.4, 0.5, 0.6, 1.74, 1.76, 9.0])
    expected = [int(np.argmin(np.abs(stamps - w))) for w in wanted]
    np.testing.assert_array_equal(nearest_rows(stamps, wanted), expected)
    np.testing.assert_array_equal(nearest_rows(stamps[:1], wanted), 0)


def test_interpolation_goes_the_shorter_way_and_keeps_out_of_gaps():
    stamps = np.array([0.0, 1.0, 11.0])
    poses = np.array([[0, 0, 3.0], [2, 0, -3.0], [4, 0, 0.0]])
    found = interpolate(stamps, poses, np.array([-0.1, 0.5, 1.0, 6.0, 12.0]), 3.0)
    assert np.isnan(found[[0, 3, 4]]).all()
    assert abs(abs(found[1, 2]) - math.pi) < 1e-9
    np.testing.assert_allclose(found[2], poses[1])


@pytest.mark.parametrize("association", ["near", "interpolated"])
def test_relations_do_not_care_for_the_frame(association):
    stamps, poses = walk()
    first, second = np.arange(30), np.arange(30) + 7
    relations = Relations(
        np.stack([stamps[first], stamps[second]], axis=1), se2.between(poses[first], poses[second])
    )
    moved = se2.compose(np.array([3.0, -2.0, 1.2]), poses)
    shuffled = np.random.default_rng(1).permutation(len(stamps))
    found = relation_errors(relations, stamps[shuffled], moved[shuffled], association)
    assert len(found.rows) == 30
    np.testing.assert_allclose(found.translation_m, 0.0, atol=1e-9)
    np.testing.assert_allclose(found.rotation_rad, 0.0, atol=1e-9)


def test_a_known_error_is_measured():
    stamps, poses = walk()
    relations = Relations(stamps[[[0, 5], [1, 6]]], se2.between(poses[[0, 1]], poses[[5, 6]]))
    wrong = poses.copy()
    wrong[5] = se2.compose(wrong[5], np.array([0.3, 0.4, 0.0]))
    wrong[6, 2] += 0.2
    found = relation_errors(relations, stamps, wrong, tolerance_s=0.0)
    np.testing.assert_allclose(found.translation_m, [0.5, 0.0], atol=1e-9)
    np.testing.assert_allclose(found.rotation_rad, [0.0, 0.2], atol=1e-9)
    row = found.summary()
    assert row["translation_mean_m"] == pytest.approx(0.25)
    assert row["translation_max_m"] == pytest.approx(0.5)
    assert row["translation_squared_mean_m2"] == pytest.approx(0.125)


def test_stamps_too_far_off_are_left_out():
    stamps, poses = walk()
    relations = Relations(
        np.array([[stamps[0] + 0.04, stamps[5]], [stamps[1] + 0.2, stamps[5]]]), np.zeros((2, 3))
    )
    np.testing.assert_array_equal(relation_errors(relations, stamps, poses).rows, [0])
    with pytest.raises(InputError, match="clocks"):
        relation_errors(Relations(relations.stamps + 1e6, relations.motion), stamps, poses)


def test_ate_with_a_clock_of_its_own():
    stamps, poses = walk()
    times = np.linspace(stamps[3], stamps[-3], 200)
    truth = interpolate(stamps, poses, times)
    moved = se2.compose(np.array([30.0, 7.0, -2.0]), poses)
    assert aligned_ate_m(times, truth, stamps, moved) < 1e-9
    with pytest.raises(InputError, match="time span"):
        aligned_ate_m(times + 1e5, truth, stamps, moved)


@needs_data
def test_rawseeds_reference_figures_to_the_printed_digit():
    members = read_members(DATA / "rawseeds_bicocca_reference/rawseeds_bicocca_25a_25b.tar.xz")
    printed = {
        "amcl_beam_model_default": ("0.149", "0.178"),
        "amcl_likelihood_default": ("0.227", "0.174"),
        "ndt_mcl_0.5": ("0.079", "0.077"),
        "muse_default_params": ("0.142", "0.132"),
        "GROUNDTRUTH-CARTOGRAPHER": ("0.059", "0.062"),
        "GT-extended": ("0.031", "0.042"),
    }
    # both sessions have files of the same names: the archive's members carry their folders then
    for run, session in enumerate(("25a", "25b")):
        folder = f"Bicocca_2009-02-{session}"

        def trajectory(name, folder=folder):
            for prefix in ("", f"{folder}-"):
                member = f"{folder}/{prefix}{name}.csv"
                if member in members:
                    return read_trajectory(split_words(members[member], member))
            raise AssertionError(name)

        truth = trajectory("GROUNDTRUTH")
        for name, figures in printed.items():
            found = trajectory(name)
            ate_m = aligned_ate_m(truth.stamps, truth.poses, found.stamps, found.poses)
            assert f"{ate_m:.3f}" == figures[run], name
        if session == "25b":
            graph = trajectory("GraphSLAM Laser")
            ate_m = aligned_ate_m(truth.stamps, truth.poses, graph.stamps, graph.poses)
            assert f"{ate_m:.3f}" == "0.074"


@needs_data
def test_kuemmerle_reference_figures():
    from sim.formats.carmen import read_carmen
    from sim.formats.intel import read_intel

    intel = read_relations(DATA / "intel_lab/intel.relations.gz")
    graph = read_carmen(DATA / "intel_lab/intel-lab.flirt.log.gz")
    found = relation_errors(intel, graph.scan_stamps, graph.scan_poses)
    assert len(found.rows) == 622
    row = found.summary()
    assert f"{row['translation_mean_m']:.4f} {row['translation_std_m']:.4f}" == "0.0482 0.0595"
    assert f"{math.degrees(row['rotation_mean_rad']):.2f}" == "1.27"
    recording = read_intel(
        DATA / "intel_lab/intel_raw_910.json.gz", DATA / "intel_lab/intel_gmapping_910.json.gz"
    )
    mapper = relation_errors(
        intel, recording.truth.stamps, recording.truth.poses, "interpolated"
    ).summary()
    assert f"{mapper['translation_mean_m']:.3f} {mapper['translation_std_m']:.3f}" == "0.126 0.117"
    freiburg = read_relations(DATA / "fr079_flirt/fr079.relations.gz")
    graph = read_carmen(DATA / "fr079_flirt/fr079.flirt.log.gz")
    near = relation_errors(freiburg, graph.scan_stamps, graph.scan_poses)
    assert len(near.rows) == 136
    assert f"{near.summary()['translation_mean_m']:.4f}" == "0.0428"
    between = relation_errors(freiburg, graph.scan_stamps, graph.scan_poses, "interpolated")
    assert f"{between.summary()['translation_mean_m']:.4f}" == "0.0456"
