import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core.metrics import PoseRelation, Unit
from evo.core.trajectory import PoseTrajectory3D
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from estimators.base import Estimate, run
from estimators.odometry import Odometry
from experiments.evaluation import metrics
from sim import se2
from sim.errors import InputError
from tests.fixtures import fakes


def trajectories(seed=0, n=400):
    """A wandering truth, and an estimate that drifts away from it."""
    rng = np.random.default_rng(seed)
    steps = np.column_stack([np.full(n, 0.1037), np.zeros(n), 0.15 * rng.standard_normal(n)])
    drift = np.array([0.004, 0.002, 0.01]) * rng.standard_normal((n, 3))
    truth, means = [np.zeros(3)], [np.array([0.3, -0.2, 0.1])]
    for step, error in zip(steps, drift, strict=True):
        truth.append(se2.compose(truth[-1], step))
        means.append(se2.compose(means[-1], step + error))
    return np.array(truth), np.array(means)


def for_evo(poses):
    quaternion = np.zeros((len(poses), 4))
    quaternion[:, 0], quaternion[:, 3] = np.cos(poses[:, 2] / 2), np.sin(poses[:, 2] / 2)
    positions = np.column_stack([poses[:, :2], np.zeros(len(poses))])
    return PoseTrajectory3D(positions, quaternion, np.arange(len(poses)) * 0.1)


@pytest.mark.parametrize("seed", range(3))
def test_ate_agrees_with_evo(seed):
    truth, means = trajectories(seed)
    ape = evo_metrics.APE(PoseRelation.translation_part)
    ape.process_data((for_evo(truth), for_evo(means)))
    ours = metrics.rms(metrics.position_errors_m(truth, means))
    assert ours == pytest.approx(ape.get_statistic(evo_metrics.StatisticsType.rmse), abs=1e-9)
    reference, moved = for_evo(truth), for_evo(means)
    moved.align(reference, correct_scale=False)
    ape.process_data((reference, moved))
    fitted = metrics.align(truth, means)
    aligned = metrics.rms(metrics.position_errors_m(truth, fitted))
    assert aligned == pytest.approx(ape.get_statistic(evo_metrics.StatisticsType.rmse), abs=1e-9)
    assert aligned < ours


@pytest.mark.parametrize("turn", [2.5, np.pi - 0.1])
def test_headings_agree_with_evo_on_both_sides_of_the_seam(turn):
    truth, means = (se2.compose(np.array([0.0, 0.0, turn]), p) for p in trajectories(3))
    ape = evo_metrics.APE(PoseRelation.rotation_angle_rad)
    reference, moved = for_evo(truth), for_evo(means)
    ape.process_data((reference, moved))
    assert np.allclose(np.abs(metrics.heading_errors_rad(truth, means)), ape.error, atol=1e-9)
    moved.align(reference, correct_scale=False)
    ape.process_data((reference, moved))
    aligned = metrics.heading_errors_rad(truth, metrics.align(truth, means))
    assert np.allclose(np.abs(aligned), ape.error, atol=1e-7)
    assert np.abs(means[:, 2] - truth[:, 2]).max() > np.pi  # the seam is crossed
    values = metrics.nees(truth, means, np.tile(np.eye(3), (len(truth), 1, 1)))
    assert values == pytest.approx(
        metrics.position_errors_m(truth, means) ** 2 + heading_squares(truth, means)
    )


def heading_squares(truth, means):
    """Squared heading errors from the angle between the heading vectors."""
    unit = [np.column_stack([np.cos(p[:, 2]), np.sin(p[:, 2])]) for p in (truth, means)]
    cross = unit[0][:, 0] * unit[1][:, 1] - unit[0][:, 1] * unit[1][:, 0]
    return np.arctan2(cross, np.sum(unit[0] * unit[1], axis=1)) ** 2


@pytest.mark.parametrize("delta_m", [1.0, 5.0])
def test_rpe_agrees_with_evo(delta_m):
    truth, means = trajectories(4)
    relations = (
        (PoseRelation.translation_part, lambda e: np.hypot(e[:, 0], e[:, 1])),
        (PoseRelation.rotation_angle_rad, lambda e: e[:, 2]),
    )
    for relation, ours in relations:
        rpe = evo_metrics.RPE(relation, delta_m, Unit.meters, pairs_from_reference=True)
        rpe.process_data((for_evo(truth), for_evo(means)))
        errors = metrics.relative_errors(truth, means, metrics.pairs_by_distance(truth, delta_m))
        expected = rpe.get_statistic(evo_metrics.StatisticsType.rmse)
        assert metrics.rms(ours(errors)) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("delta", [1, 7, 50])
def test_rpe_over_frames_agrees_with_evo(delta):
    truth, means = trajectories(5)
    rpe = evo_metrics.RPE(PoseRelation.translation_part, delta, Unit.frames)
    rpe.process_data((for_evo(truth), for_evo(means)))
    rows = np.arange(0, len(truth), delta)
    pairs = np.stack([rows[:-1], rows[1:]], axis=1)  # consecutive, without overlap
    errors = metrics.relative_errors(truth, means, pairs)
    ours = np.hypot(errors[:, 0], errors[:, 1])
    assert np.allclose(ours, rpe.error, atol=1e-9, rtol=0)


@given(st.tuples(st.floats(-9, 9), st.floats(-9, 9), st.floats(-3, 3)).map(np.array))
def test_aligned_errors_do_not_see_a_rigid_motion(motion):
    truth, means = trajectories(1, 60)
    moved = se2.compose(motion, means)
    before, after = metrics.align(truth, means), metrics.align(truth, moved)
    assert np.allclose(before[:, :2], after[:, :2], atol=1e-9)
    assert np.allclose(se2.wrap(before[:, 2] - after[:, 2]), 0, atol=1e-9)


def test_alignment_is_the_least_squares_one():
    truth, means = trajectories(2, 100)
    best = metrics.alignment(truth, means)
    least = metrics.rms(metrics.position_errors_m(truth, se2.compose(best, means)))
    for nudge in np.vstack([np.eye(3), -np.eye(3)]) * 1e-3:
        other = se2.compose(best + nudge, means)
        assert metrics.rms(metrics.position_errors_m(truth, other)) > least


def test_nees_has_the_chi_square_mean_and_leaves_singular_covariances_out():
    rng = np.random.default_rng(0)
    root = np.array([[0.3, 0, 0], [0.1, 0.2, 0], [0.02, -0.01, 0.05]])
    truth = rng.normal(size=(20_000, 3))
    means = truth + rng.standard_normal((20_000, 3)) @ root.T
    covariances = np.tile(root @ root.T, (20_000, 1, 1))
    covariances[0] = 0.0
    covariances[1] = np.outer([1, 1, 1], [1, 1, 1])
    values = metrics.nees(truth, means, covariances)
    assert np.isnan(values[:2]).all()
    assert np.nanmean(values) == pytest.approx(3.0, abs=0.06)
    direct = (means[5] - truth[5]) @ np.linalg.solve(covariances[5], means[5] - truth[5])
    assert values[5] == pytest.approx(direct)


def test_ellipse_holds_95_percent():
    rng = np.random.default_rng(1)
    root = np.array([[0.4, 0.0], [0.25, 0.1]])
    area = metrics.ellipse_area_m2(np.pad(root @ root.T, ((0, 1), (0, 1)))[None])[0]
    sample = rng.standard_normal((100_000, 2)) @ root.T
    distance = np.sum(sample * np.linalg.solve(root @ root.T, sample.T).T, axis=1)
    assert np.mean(distance <= metrics.CHI2_95_2DOF) == pytest.approx(0.95, abs=0.003)
    assert area == pytest.approx(np.pi * 5.991464547 * abs(np.linalg.det(root)))


def test_rows_at_distances():
    truth = np.column_stack([np.arange(11) * 0.5, np.zeros(11), np.zeros(11)])
    assert metrics.at_distances(truth, np.array([0.0, 1.0, 1.2, 5.0, 9.0])).tolist() == [
        0,
        2,
        3,
        10,
        -1,
    ]


def test_nees_at_distances_has_no_value_beyond_the_end():
    truth = np.column_stack([np.arange(11) * 0.5, np.zeros(11), np.zeros(11)])
    means = truth + np.column_stack([np.arange(11.0), np.zeros(11), np.zeros(11)])
    covariances = np.tile(np.eye(3), (11, 1, 1))
    values = metrics.nees_at_distances(truth, means, covariances, np.array([1.0, 5.0, 9.0]))
    assert values[:2].tolist() == [4.0, 100.0]
    assert np.isnan(values[2])


def test_nees_leaves_out_what_is_not_finite():
    truth, covariances = np.zeros((4, 3)), np.tile(np.eye(3), (4, 1, 1))
    covariances[0], covariances[1, 0, 1] = np.inf, np.nan
    means = np.ones((4, 3))
    means[2] = np.nan
    assert np.isnan(metrics.nees(truth, means, covariances)).tolist() == [True, True, True, False]


def test_dead_reckoning_of_the_circle_is_consistent():
    distances, n = np.array([1.0, 2.0]), 60
    values = []
    for seed in range(n):
        recording = fakes.circle(seed, kr=1e-4, kl=3e-5)
        prior = fakes.tracking_prior(recording, sigma=(0.0, 0.0, 0.0))
        found = run(Odometry(kr=1e-4, kl=3e-5), recording, prior, np.random.default_rng(0))
        truth = recording.truth_at(found.stamps)
        values.append(metrics.nees_at_distances(truth, found.means, found.covariances, distances))
    low, high = stats.chi2.ppf([0.025, 0.975], 3 * n) / n
    for nees in np.mean(values, axis=0):
        assert low < nees < high


def test_score_leaves_out_what_does_not_apply_and_shows_what_is_not_finite():
    recording = fakes.circle()  # 2.97 m
    row = metrics.score(recording, fakes.estimate(recording))
    assert "rpe_1m_rmse_m" in row
    assert "rpe_10m_rmse_m" not in row
    assert row["distance_m"] == pytest.approx(2.97, rel=1e-3)
    assert row["step_time_us"] == pytest.approx(10.0)
    zero = np.zeros((100, 3, 3))
    unknown = metrics.score(recording, fakes.estimate(recording, None, zero))
    of_covariances = {"nees_mean", "nees_counted_share", "ellipse_area_final_m2"}
    assert not of_covariances & set(unknown)
    assert of_covariances <= set(row)
    lost = recording.truth.poses.copy()
    lost[50:] = np.nan
    row = metrics.score(recording, fakes.estimate(recording, lost))
    assert np.isnan(row["ate_rmse_m"])
    assert np.isnan(row["ate_aligned_rmse_m"])


def test_stamps_outside_the_truth_are_left_out():
    import dataclasses

    recording = fakes.circle()
    truth = recording.truth
    short = dataclasses.replace(truth, stamps=truth.stamps[:60], poses=truth.poses[:60])
    means = truth.poses.copy()
    means[60:] += 5.0
    row = metrics.score(
        dataclasses.replace(recording, truth=short), fakes.estimate(recording, means)
    )
    assert row["ate_rmse_m"] == pytest.approx(0.0, abs=1e-9)
    apart = dataclasses.replace(truth, stamps=truth.stamps + 1e9)
    with pytest.raises(InputError, match="clocks"):
        metrics.score(dataclasses.replace(recording, truth=apart), fakes.estimate(recording, means))
    without = metrics.score(
        dataclasses.replace(recording, truth=None), fakes.estimate(recording, means)
    )
    assert set(without) == {"duration_s", "step_time_us"}


def test_frames_in_a_gap_of_the_truth_are_not_scored():
    """As in a thinned log: between true poses far apart the robot did not drive straight."""
    import dataclasses

    recording = fakes.circle()  # 100 frames, 0.1 s apart
    truth = recording.truth
    rows = np.array([*range(20), *range(60, 100)])  # 4.1 s are missing
    holed = dataclasses.replace(
        recording,
        truth=dataclasses.replace(truth, stamps=truth.stamps[rows], poses=truth.poses[rows]),
    )
    estimate = fakes.estimate(recording)
    row = metrics.score(holed, estimate)
    assert (row["stamps_scored"], row["stamps_left_out"]) == (60, 40)
    assert row["ate_rmse_m"] == pytest.approx(0.0, abs=1e-9)
    drawn_across = metrics.score(holed, estimate, longest_gap_s=10.0)
    assert drawn_across["stamps_left_out"] == 0
    assert drawn_across["ate_rmse_m"] > 0.05
    sparse = dataclasses.replace(truth, stamps=truth.stamps[::9] + 0.01, poses=truth.poses[::9])
    with pytest.raises(InputError, match=r"scoring\.longest_gap_s"):
        metrics.score(dataclasses.replace(recording, truth=sparse), estimate)


def test_every_score_says_its_unit():
    recording = fakes.circle(n_frames=400)
    pure = {"nees_mean", "nees_counted_share", "final_in_ellipse"}
    pure |= {"stamps_scored", "stamps_left_out"} | {f"inside_{p}_share" for p in (50, 90, 95)}
    keys = set(metrics.score(recording, fakes.estimate(recording)))
    assert {
        *("ate_rmse_m", "ate_aligned_rmse_m", "heading_rmse_rad", "heading_aligned_rmse_rad"),
        *("rpe_1m_rmse_m", "rpe_10m_rmse_m", "rpe_10m_heading_rmse_rad", "nees_mean"),
        *("final_position_error_m", "final_heading_error_rad", "ellipse_area_final_m2"),
        *("step_time_us", "distance_m", "duration_s"),
    } <= keys
    assert all(key in pure or key.endswith(("_m", "_rad", "_m2", "_us", "_s")) for key in keys)


def test_score_of_a_perfect_estimate_is_zero():
    from tests.sim.test_recording import small_recording

    recording = small_recording()
    truth = recording.truth_at(recording.frame_stamps)
    estimate = Estimate(recording.frame_stamps, truth, np.tile(np.eye(3), (6, 1, 1)))
    row = metrics.score(recording, estimate)
    for key in ("ate_rmse_m", "heading_rmse_rad", "final_position_error_m", "nees_mean"):
        assert row[key] == pytest.approx(0.0, abs=1e-12), key


def test_a_position_lies_in_the_ellipse_or_not():
    """Semi-axes of the 95 % ellipse are sqrt(5.991) sigmas; a quarter turn swaps them."""
    covariance = np.diag([4.0, 1.0, 9.0])
    for at, inside in (((4.89, 0.0), True), ((4.90, 0.0), False), ((0.0, 2.44), True),
                       ((0.0, 2.45), False), ((4.0, 2.0), False)):  # fmt: skip
        assert metrics.in_ellipse(np.array([*at, 5.0]), np.zeros(3), covariance) is inside
    turned = np.diag([1.0, 4.0, 9.0])
    assert not metrics.in_ellipse(np.array([4.89, 0.0, 0.0]), np.zeros(3), turned)


def test_the_ellipse_of_a_singular_covariance_holds_nothing():
    pose, near, far = np.zeros(3), np.array([0.1, 0.0, 0.0]), np.array([0.3, 0.0, 0.0])
    for block in (np.zeros((2, 2)), np.ones((2, 2))):
        covariance = np.diag([0.0, 0.0, 1e-6])
        covariance[:2, :2] = block
        assert not metrics.in_ellipse(pose, near, covariance)
    covariance = np.diag([0.01, 0.01, 1e-6])
    assert metrics.in_ellipse(pose, near, covariance)
    assert not metrics.in_ellipse(pose, far, covariance)


def test_shares_inside_are_those_of_a_consistent_method():
    rng = np.random.default_rng(4)
    roots = rng.normal(size=(4000, 3, 3)) * 0.05
    covariances = roots @ roots.transpose(0, 2, 1)
    means = (roots @ rng.normal(size=(4000, 3, 1)))[:, :, 0]
    row = metrics.path_scores(np.zeros((4000, 3)), means, covariances)
    for percent in (50, 90, 95):
        assert row[f"inside_{percent}_share"] == pytest.approx(percent / 100, abs=0.03)
    assert row["sharpness_m"] == pytest.approx(row["ate_rmse_m"], rel=0.05)
    timid = metrics.path_scores(np.zeros((4000, 3)), means, 100.0 * covariances)
    assert timid["inside_50_share"] > 0.95
