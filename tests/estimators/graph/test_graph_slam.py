"""Pose graphs against dense and independent solvers; loops that close, and those that must not."""

import dataclasses

import numpy as np
import pytest

from estimators.base import run
from estimators.gaussian import Gaussian
from estimators.graph import least_squares
from estimators.graph.graph_slam import GraphSlam
from estimators.graph.least_squares import LeastSquaresOptions, solve
from estimators.graph.loop_closing import LoopOptions, LoopSearch, Patches, Seen
from estimators.graph.place_search import agreement, make_patch
from estimators.graph.pose_graph import Edge, PoseGraph
from estimators.graph.residual_noise import ResidualNoise
from estimators.laser.icp import prepare
from estimators.laser.scan_lines import without_sparse_lines
from estimators.laser.scan_matching import MatcherOptions, ScanMatcher
from estimators.odometry import Odometry
from experiments.evaluation.relations import judged_relations
from experiments.gate.conform import check_estimator
from sim import se2
from sim.errors import InputError
from sim.formats.relations import Relations
from sim.sensors import Laser
from tests.fixtures.fakes import circle, room_ranges_m, tracking_prior

R = np.diag([4e-4, 2e-4, 1e-4])
LAP = 40  # nodes of a lap
STEP = np.array([0.5, 0.0, 2.0 * np.pi / LAP])


def lap(n, rng, n_closures=5):
    """A graph of n nodes round a circle, its true poses, and true closures of a lap's length."""
    truth = se2.chain(np.tile(STEP, (n - 1, 1)))
    graph = PoseGraph(Gaussian(np.zeros(3), 1e-4 * np.eye(3)), robust_sigma=5.0)
    for _ in range(n - 1):
        motion = STEP + rng.multivariate_normal(np.zeros(3), R)
        graph.add(motion, [Gaussian(motion, R)])
    ends = np.linspace(LAP + 2, n - 1, n_closures).astype(int)
    return graph, truth, [closure(truth, end - LAP - 1, end, rng) for end in ends]


def closure(truth, first, second, rng, off=(0.0, 0.0, 0.0)):
    motion = se2.between(truth[first], truth[second]) + off
    return Edge(
        int(first), int(second), Gaussian(motion + rng.multivariate_normal(np.zeros(3), R), R)
    )


def search(**changed):
    how = LoopOptions(**{"loop_min_gain": 1.0} | changed)
    return LoopSearch(ScanMatcher(MatcherOptions()), Laser(), how)


def test_the_sparse_solution_is_the_dense_one(monkeypatch):
    rng = np.random.default_rng(0)
    graph, _, closures = lap(150, rng)
    graph.closures += closures
    problem, start = graph._problem(), graph.poses
    sparse = solve(problem, start, LeastSquaresOptions(robust="dcs", robust_sigma=5.0))
    monkeypatch.setattr(least_squares, "_SPARSE_POSES", 10**6)
    dense = solve(problem, start, LeastSquaresOptions(robust="dcs", robust_sigma=5.0))
    assert sparse.converged
    np.testing.assert_allclose(sparse.poses, dense.poses, atol=1e-8)
    some = np.array([3, 149, 70])
    whole = dense.covariance.reshape(150, 3, 150, 3)
    scale = np.abs(dense.covariance).max()
    for found in (sparse, dense):
        blocks = found.information.marginals(some)
        np.testing.assert_allclose(blocks, whole[some, :, some], atol=1e-9 * scale)
        joint = found.information.joint(some).reshape(3, 3, 3, 3)
        np.testing.assert_allclose(joint[0, :, 1], whole[3, :, 149], atol=1e-9 * scale)


def test_covariances_kept_along_the_chain_are_those_of_the_whole_graph():
    rng = np.random.default_rng(1)
    graph, _, closures = lap(70, rng)
    graph.close(closures[:2])
    for _ in range(6):
        graph.add(STEP, [Gaussian(STEP, R), Gaussian(STEP, 3.0 * R)])
    kept = [part.copy() for part in graph.newest_from(np.arange(len(graph) - 1), exact=True)]
    found = graph.seen_from(np.arange(len(graph) - 1), len(graph) - 1)
    for mine, theirs in zip(kept, found, strict=True):
        np.testing.assert_allclose(mine, theirs, atol=1e-9)


def test_covariances_that_are_not_exact_are_too_large():
    rng = np.random.default_rng(2)
    graph, _, closures = lap(70, rng)
    graph.newest_from(np.arange(60), exact=True)
    graph.close(closures)
    nodes = np.arange(60)
    _, rough = graph.newest_from(nodes, exact=False)
    _, exact = graph.newest_from(nodes, exact=True)
    assert np.linalg.eigvalsh(rough - exact).min() > -1e-9
    assert np.trace(rough - exact, axis1=1, axis2=2).max() > 1e-4


def test_a_wrong_closure_does_not_bend_the_graph():
    rng = np.random.default_rng(3)
    graph, truth, closures = lap(120, rng, n_closures=12)
    wrong = closure(truth, 10, 100, rng, off=(2.0, -3.0, 0.5))
    graph.close([*closures, wrong])
    assert np.hypot(*(graph.poses - truth)[:, :2].T).max() < 0.6
    squarely = solve(graph._problem(), graph.poses)
    assert np.hypot(*(squarely.poses - truth)[:, :2].T).max() > 0.6


def test_a_long_loop_closes_however_far_it_has_drifted():
    """Closures that miss by hundreds of their own standard deviations still pull."""
    rng = np.random.default_rng(7)
    graph, truth, _ = lap(120, rng)
    sharp = 1e-6 * np.eye(3)
    edges = [
        Edge(i, i + 100, Gaussian(se2.between(truth[i], truth[i + 100]), sharp))
        for i in (10, 12, 14)
    ]
    assert graph._farthest(edges) > 100.0
    graph.close(edges)
    assert graph._farthest(edges) < 3.0


def test_the_loss_of_closures_is_the_integral_of_its_weight():
    squares = np.linspace(0.0, 200.0, 20001)
    loss, weight = LeastSquaresOptions(robust="dcs").loss(squares)
    np.testing.assert_allclose(np.gradient(loss, squares)[1:-1], weight[1:-1], atol=2e-3)
    assert loss.max() < 3.0 * 9.0


def test_joint_innovations_have_the_covariance_that_they_claim():
    rng = np.random.default_rng(4)
    squared = []
    for _ in range(40):
        graph, _, closures = lap(60, rng, n_closures=3)
        off, S = graph.joint_innovation(closures)
        squared.append(off @ np.linalg.solve(S, off))
    assert np.mean(squared) == pytest.approx(9.0, abs=4.0 * np.sqrt(18.0 / 40.0))


def test_of_held_closures_those_that_agree_are_found():
    rng = np.random.default_rng(5)
    graph, truth, right = lap(120, rng, n_closures=5)
    wrong = [
        closure(truth, 20, 100, rng, off=(1.0, -1.5, 0.2)),
        closure(truth, 25, 110, rng, off=(-2.0, 1.0, -0.3)),
    ]
    found = search().consistent(graph, [wrong[0], *right, wrong[1]])
    assert found == right


def test_a_twin_of_a_place_makes_closures_wait():
    """Closures that are all off by the same, as of a place that looks alike, against right ones."""
    rng = np.random.default_rng(8)
    graph, truth, _ = lap(120, rng)
    right = [closure(truth, i, i + 85, rng) for i in (19, 21, 23, 25, 27, 29)]
    twins = []
    for i in (20, 22, 24, 26):
        cos, sin = np.cos(truth[i, 2]), np.sin(truth[i, 2])
        twins.append(closure(truth, i, i + 85, rng, off=(0.3 * cos, -0.3 * sin, 0.0)))  # in map
    assert search().consistent(graph, [*right, *twins]) == []
    assert search().consistent(graph, [*right, *twins[:2]]) == right


def test_agrees_with_gtsam():
    gtsam = pytest.importorskip("gtsam")
    rng = np.random.default_rng(6)
    truth_graph, _, closures = lap(120, rng)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    exact = gtsam.noiseModel.Gaussian.Covariance
    graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(), exact(1e-4 * np.eye(3))))
    for edge in [*truth_graph._chain, *closures]:
        cos, sin = np.cos(edge.motion.mean[2]), np.sin(edge.motion.mean[2])
        turn = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])  # into its axes
        model = exact(turn @ edge.motion.covariance @ turn.T)
        motion = gtsam.Pose2(*edge.motion.mean)
        graph.add(gtsam.BetweenFactorPose2(edge.first, edge.second, motion, model))
    for i, pose in enumerate(truth_graph.poses):
        values.insert(i, gtsam.Pose2(*pose))
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    truth_graph.close(closures)
    for i, pose in enumerate(truth_graph.poses):
        theirs = found.atPose2(i)
        assert np.hypot(theirs.x() - pose[0], theirs.y() - pose[1]) < 5e-3
    n = len(truth_graph) - 1
    theirs = gtsam.Marginals(graph, found).marginalCovariance(n)
    mine = truth_graph.marginals()[n]
    assert np.trace(mine) == pytest.approx(np.trace(theirs), rel=0.05)


def two_visits(n_rooms, return_to, sigma_m):
    """Rooms in a row that look the same, 9 m apart, and then again one of them.

    The robot knows only its way within a room; between rooms it may be off by `sigma_m`.
    """
    laser = Laser(n_beams=121, fov_rad=np.pi)
    within = np.column_stack([np.linspace(-1.5, 1.0, 11), np.linspace(-1.0, 1.2, 11), np.zeros(11)])
    scans = [prepare(ranges, laser.bearings_rad) for ranges in room_ranges_m(laser, within)]
    starts = [np.array([9.0 * k, 0.0, 0.0]) for k in [*range(n_rooms), return_to]]
    truth = np.concatenate([[np.zeros(3)], *(start + within for start in starts)])
    graph, patches = PoseGraph(Gaussian(np.zeros(3), 1e-4 * np.eye(3)), 5.0), Patches(np.zeros(3))
    patches.key_frames.append(Seen(None, 0.0))
    for k, motion in enumerate(se2.between(truth[:-1], truth[1:])):
        leaps = k % 11 == 0
        noise = np.diag(np.square([sigma_m, sigma_m, 0.02] if leaps and k else [0.01, 0.01, 0.002]))
        graph.add(motion, [Gaussian(motion, noise)])
        driven_m = patches.key_frames[-1].driven_m + (10.0 if leaps else np.hypot(*motion[:2]))
        patches.key_frames.append(Seen(scans[k % 11], driven_m))
    how = LoopSearch(ScanMatcher(MatcherOptions()), laser, LoopOptions())
    return how.find_place(graph, patches, len(graph) - 1, patches.anchors()), truth


def test_a_place_that_was_seen_before_is_found():
    found, truth = two_visits(n_rooms=1, return_to=0, sigma_m=1.0)
    anchor, place = found
    np.testing.assert_allclose(place.mean, se2.between(truth[anchor], truth[-1]), atol=0.1)
    assert np.sqrt(np.diag(place.covariance)).max() < 1.0


def test_of_places_that_look_alike_none_is_found():
    """The nearest is right, but the uncertainty reaches the other: no closure until it is known."""
    assert two_visits(n_rooms=2, return_to=1, sigma_m=4.0)[0] is None
    assert two_visits(n_rooms=2, return_to=1, sigma_m=0.5)[0] is not None


def test_walls_in_free_space_deny_a_place():
    laser = Laser(n_beams=121, fov_rad=np.pi)
    scan = prepare(room_ranges_m(laser, np.zeros((1, 3)))[0], laser.bearings_rad)
    patch = make_patch(np.zeros((1, 3)), [scan.points], np.zeros(3))
    assert agreement(patch, patch, np.zeros(3)) == (1.0, pytest.approx(1.0, abs=0.1))
    assert agreement(patch, patch, np.array([1.0, 0.0, 0.0]))[0] < 0.5


def test_noise_follows_from_what_wheels_and_scans_say():
    """Wheels with a fifth of their noise believed, and a gain; scans with a tenth of theirs."""
    rng, noise = np.random.default_rng(9), ResidualNoise()
    wheels, scans = np.array([0.02, 0.01, 0.03]), np.array([0.004, 0.004, 0.002])
    for _ in range(300):
        truth = np.array([0.5, 0.0, rng.uniform(-0.3, 0.3)])
        logged = truth * [1.04, 1.0, 0.95] + wheels * rng.standard_normal(3)
        by_wheels = Gaussian(logged, np.diag(np.square(wheels / 5.0)))
        noise.compare_wheels(by_wheels, Gaussian(truth, 1e-8 * np.eye(3)))
        R = np.diag(np.square(scans / 10.0))
        ties = [Gaussian(truth + scans * rng.standard_normal(3), R) for _ in range(2)]
        twice = Gaussian(truth, R).then(Gaussian(truth, R)).mean
        direct = Gaussian(twice + scans * rng.standard_normal(3), R)
        noise.compare_scans(direct, *ties)
    found = noise.corrected(by_wheels)
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance)), wheels, rtol=0.25)
    assert np.sqrt(noise.of_scans) == pytest.approx(10.0, rel=0.2)
    straight = noise.corrected(Gaussian(np.array([0.52, 0.0, 0.0]), np.eye(3)))
    assert straight.mean[0] == pytest.approx(0.5, abs=0.01)


def test_edges_far_behind_one_another_are_no_wall():
    """Posts of doors in a row, one beam on each, 6 m apart on one line; and a wall."""
    posts = np.array([[6.0, 1.2], [12.0, 1.2], [18.0, 1.2], [24.0, 1.2]])
    wall = np.column_stack([np.full(30, 3.0), np.linspace(-2.0, -0.2, 30)])
    points = np.concatenate([wall, posts[::-1]])
    bearings = np.arctan2(points[:, 1], points[:, 0])
    order = np.argsort(bearings)
    scan = prepare(np.hypot(*points.T)[order], bearings[order])
    assert len(scan.lines) == 2
    kept = without_sparse_lines(scan, 1.5)
    assert len(kept.lines) == len(kept.segments.normals) == len(kept.line_ends) == 1
    assert np.count_nonzero(kept.line_of_point == 0) == 30
    np.testing.assert_allclose(kept.lines[0], [1.0 / 3.0, 0.0], atol=1e-9)
    assert without_sparse_lines(scan, 10.0) is scan


def test_relations_of_unknown_stamps_and_of_a_scan_with_itself_judge_nothing():
    stamps = np.array([[0.0, 10.0], [0.0, 0.02], [0.0, 20.0], [10.0, 20.0]])
    relations = Relations(stamps, np.arange(12.0).reshape(4, 3))
    known, others = np.array([0.01, 10.0, 19.0]), np.array([0.0, 0.02, 10.04, 20.0])
    assert judged_relations(relations, known, others).stamps.tolist() == [[0.0, 10.0]]


# --- the estimator -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def laps():
    """Two laps of a circle, wheels so poor that dead reckoning is lost after one."""
    return circle(n_frames=360, radius_m=1.0, rate_hz=5.0, kr=5e-4, kl=5e-4)


def tracked(recording, **options):
    estimator = GraphSlam(kr=5e-4, kl=5e-4, keyframe_distance_m=0.3, **options)
    prior = tracking_prior(recording)
    return estimator, run(estimator, recording, prior, np.random.default_rng(0))


def error_m(recording, estimate):
    off = estimate.means - recording.truth_at(estimate.stamps)
    return np.hypot(off[:, 0], off[:, 1])


def test_loops_close_and_bound_the_error(laps):
    estimator, online = tracked(laps)
    revised = estimator.finish()
    truth = laps.truth_at(laps.frame_stamps)
    assert online.status == "ok"
    assert estimator.graph.closures
    assert revised.kind == "revised"
    dead = Odometry(kr=5e-4, kl=5e-4)
    lost = run(dead, laps, tracking_prior(laps), np.random.default_rng(0))
    assert error_m(laps, lost).max() > 0.3
    assert error_m(laps, online).max() < 0.03
    assert error_m(laps, revised).max() < 0.03
    off = se2.difference(revised.means, truth)[1:]
    nees = np.einsum("ti,tij,tj->t", off, np.linalg.inv(revised.covariances[1:]), off)
    assert nees.mean() / 3.0 < 3.0


@pytest.mark.slow
def test_false_closures_are_not_believed(laps, monkeypatch):
    """As many false candidates as right ones, each within what its own pose allows."""
    rng = np.random.default_rng(1)
    proposed = GraphSlam.propose_closures
    planted = []

    def with_false_ones(self):
        newest = len(self.graph) - 1
        found = proposed(self)
        if newest > 5:
            first = int(rng.integers(newest - 3))
            off = rng.uniform([0.2, 0.2, -0.5], [2.0, 2.0, 0.5])
            motion = se2.between(self.graph.poses[first], self.graph.poses[newest]) + off
            planted.append(Edge(first, newest, Gaussian(motion, 1e-5 * np.eye(3))))
            found = [*found, planted[-1]]
        return found

    monkeypatch.setattr(GraphSlam, "propose_closures", with_false_ones)
    estimator, online = tracked(laps)
    assert planted
    assert not [edge for edge in planted if edge in estimator.graph.closures]
    assert error_m(laps, online).max() < 0.03


@pytest.mark.slow
def test_a_false_loop_is_withdrawn_when_what_follows_denies_it(laps):
    """Planted and believed after a lap; the walls that are seen from then on do not fit."""
    estimator = GraphSlam(kr=5e-4, kl=5e-4, keyframe_distance_m=0.3, robust_sigma=1e4)
    planted = None

    def step(frame):
        nonlocal planted
        belief = stepped(frame)
        newest = len(estimator.graph) - 1
        if planted is None and estimator._patches.key_frames[-1].driven_m > 8.5:
            off = se2.between(estimator.graph.poses[2], estimator.graph.poses[newest])
            planted = Edge(2, newest, Gaussian(off + np.array([1.5, 1.0, 0.4]), 1e-7 * np.eye(3)))
            estimator.graph.keep([planted])
            estimator._groups = [newest]
        return belief

    stepped, estimator.step = estimator.step, step
    online = run(estimator, laps, tracking_prior(laps), np.random.default_rng(0))
    assert error_m(laps, online).max() > 0.5  # it was believed
    assert planted not in estimator.graph.closures
    assert error_m(laps, estimator.finish()).max() < 0.1


def test_without_closures_it_is_a_chain(laps):
    estimator, online = tracked(laps, loop_reach_m=1e-6, revisions=0)
    assert not estimator.graph.closures
    revised = estimator.finish()
    np.testing.assert_allclose(revised.means, online.means, atol=1e-12)


@pytest.mark.slow
def test_it_conforms():
    recording = circle(n_frames=60)
    results = check_estimator(
        lambda: GraphSlam(keyframe_distance_m=0.1, kr=1e-5, kl=1e-5),
        recording,
        tracking_prior(recording),
    )
    assert not [r for r in results if not r.passed]


def test_frames_without_scans_and_before_the_first():
    recording = circle(n_frames=20)
    laser = recording.log("laser")
    late = dataclasses.replace(
        laser,
        stamps=laser.stamps[8::4],
        values={name: values[8::4] for name, values in laser.values.items()},
    )
    recording = recording.with_log("laser", late)
    estimator, online = tracked(recording)
    revised = estimator.finish()
    assert np.isfinite(online.covariances).all()
    np.testing.assert_allclose(revised.means[:8], online.means[:8], atol=1e-9)


def test_bad_options_and_no_frames_are_refused():
    with pytest.raises(InputError, match="loop_support"):
        GraphSlam(loop_support=0)
    with pytest.raises(InputError, match="max_gap_m"):
        GraphSlam(max_gap_m=0.0)
    with pytest.raises(InputError, match="shared_noise"):
        GraphSlam(shared_noise=1.0)
    estimator = GraphSlam()
    estimator.reset(tracking_prior(circle(n_frames=3)), np.random.default_rng(0))
    with pytest.raises(InputError, match="no Frame"):
        estimator.finish()
