"""The topological filter: its weights by hand, its motion on odd graphs, localization, recovery."""

import dataclasses
import math

import numpy as np
import pytest

from estimators.base import Prior, run
from estimators.topological.node_weights import node_log_weights
from estimators.topological.place_refinement import Refiner, find_turns_rad
from estimators.topological.topological_map import Edges, from_arrays, from_recording
from estimators.topological.topological_mcl import TopologicalMcl
from experiments.gate.conform import check_estimator
from experiments.papers.maximo2024 import places
from sim import se2
from sim.errors import InputError
from sim.recording import Frame
from sim.robot.drive import RobotGeometry
from sim.sensors import PlaceDescriptor
from tests.estimators.topological.test_topological_map import LIDAR, ring_run
from tests.fixtures.fakes import blind, place_route, with_reading

PAPER = {
    "motion": "paper",
    "resampling": "always",
    "scheme": "multinomial",
    "injection": 0.0,
    "estimate": "mean",
}
ROBOT = RobotGeometry(0.1, 0.4)
PLACES = {"place": PlaceDescriptor()}


def line_map(n=10, step_m=2.0, join=True):
    positions = np.column_stack([step_m * np.arange(n), np.zeros(n)])
    return from_arrays(positions, np.eye(n), break_m=None if join else 0.1)


def frame(i, travel_m=2.0, descriptor=None, cloud_ranges_m=None):
    readings = {}
    if descriptor is not None:
        readings["place"] = {"descriptor": np.asarray(descriptor, np.float32)}
    if cloud_ranges_m is not None:
        readings["lidar3d"] = {"ranges_m": cloud_ranges_m}
    return Frame(float(i), 1.0, np.array([travel_m, travel_m]), readings)


def started(known, seed=0, sensors=None, **options):
    estimator = TopologicalMcl(**options)
    prior = Prior(ROBOT, sensors or PLACES, map=known)
    estimator.reset(prior, np.random.default_rng(seed))
    return estimator


def test_weights_are_those_of_the_equations():
    rng = np.random.default_rng(0)
    nodes, nearest = rng.normal(0, 5, (6, 2)), rng.normal(0, 5, (4, 2))
    h, sigma_l, sigma_m = rng.uniform(0.5, 1.0, 4), 3.0, 0.2
    scaled = h / h.sum()
    for name in ("M1", "M2", "M3"):
        found = node_log_weights(nodes, nearest, h, name, sigma_l, sigma_m)
        for i in range(6):
            terms = []
            for j in range(4):
                v = nearest[j] - nodes[i]
                term = math.exp(-(v @ v) / sigma_l**2)
                terms.append(
                    term * (math.exp(-((scaled[j] / sigma_m) ** 2)) if name != "M1" else 1)
                )
            whole = math.prod(terms) if name == "M3" else sum(terms)
            assert found[i] == pytest.approx(math.log(whole), rel=1e-12)


def test_weights_do_not_underflow_and_m3_is_a_gaussian_about_the_centroid():
    nodes = np.array([[0.0, 0.0], [1e5, 0.0], [7e4, 1e4]])
    nearest = np.array([[9e4, 1e4], [1.1e5, -2e4]])
    h = np.array([0.3, 0.4])
    for name in ("M1", "M2", "M3"):
        found = node_log_weights(nodes, nearest, h, name, 1.0, 0.1)
        assert np.isfinite(found).all()
    centroid = nearest.mean(axis=0)
    squares = np.sum((nodes - centroid) ** 2, axis=1)
    expected = -2.0 * squares  # B / sigma_l^2
    np.testing.assert_allclose(found - found[1], expected - expected[1], rtol=1e-9)
    exact = node_log_weights(nodes, nodes[:2], np.zeros(2), "M2", 1.0, 0.1)
    assert exact[0] == pytest.approx(0.0)


def test_the_graph_goes_on_and_never_back_but_at_dead_ends():
    # a T: 0-1-2-3 with 4 beyond 1, and 5 alone
    known = dataclasses.replace(
        from_arrays(np.random.default_rng(0).normal(size=(6, 2)), np.eye(6)),
        edges=np.array([[0, 1], [1, 2], [1, 4], [2, 3]]),
    )
    graph = Edges(known)
    assert np.all(graph.tail[graph.reverse] == graph.head)
    assert np.all(graph.reverse[graph.reverse] == np.arange(len(graph.tail)))
    rng = np.random.default_rng(1)
    ways = {}
    for e in range(len(graph.tail)):
        onward = graph.next(np.full(400, e), rng.random(400))
        assert np.all(graph.tail[onward] == graph.head[e])
        ways[int(graph.tail[e]), int(graph.head[e])] = set(graph.head[onward].tolist())
        before = graph.before(np.full(400, e), rng.random(400))
        assert np.all(graph.head[before] == graph.tail[e]) or graph.tail[e] in (0, 3, 4)
    assert ways[0, 1] == {2, 4}
    assert ways[4, 1] == {0, 2}
    assert ways[2, 1] == {0, 4}
    assert ways[1, 2] == {3}
    assert ways[2, 3] == {2}  # the dead end sends it back
    assert ways[5, 5] == {5}


def test_paper_motion_hops_one_node_an_observation_and_not_before_the_first():
    known = line_map()
    estimator = started(known, particles_per_node=2, weighting="M1", sigma_l_m=1e6, **PAPER)
    estimator.step(frame(0))  # no observation: nobody moves
    first = estimator.step(frame(1, descriptor=np.eye(10)[0])).extras["particles"]
    second = estimator.step(frame(2, descriptor=np.eye(10)[0])).extras["particles"]
    # flat weights: the interior particles have gone 2 m the way they face, half of them each way
    assert np.isin(second[:, 0], 2.0 * np.arange(10)).all()
    assert set(np.round(np.abs(first[:, 2]), 3)) == {0.0, 3.142}
    assert 2 <= np.unique(second[:, 0]).size <= 10


def test_odometry_motion_follows_steps_of_any_length():
    """Known start and direction: after any number of steps the node is the one reached."""
    known = line_map(60)
    prior = Prior(ROBOT, PLACES, np.array([10.0, 0.0, 0.0]), np.diag([1e-4, 1e-4, 1e-4]), known)
    for travel in (0.37, 2.0, 5.3):
        estimator = TopologicalMcl(
            p_stay=0.0, p_skip=0.0, p_turn=0.0, sigma_l_m=0.3, injection=0.0, particles_per_node=50
        )
        estimator.reset(prior, np.random.default_rng(0))
        n_steps = int(60.0 / travel)
        for i in range(n_steps):
            belief = estimator.step(frame(i, travel))
        belief = estimator._summary({})
        assert belief.mean[0] == pytest.approx(10.0 + n_steps * travel, abs=1.5)
        for i in range(n_steps):
            estimator.step(frame(i, -travel))  # and back again, in reverse
        belief = estimator._summary({})
        assert belief.mean[0] == pytest.approx(10.0, abs=1.5)
        assert abs(belief.mean[2]) < 0.1


def test_stay_and_skip_spread_the_particles_without_bias():
    known = line_map(200)
    prior = Prior(ROBOT, PLACES, np.array([40.0, 0.0, 0.0]), np.diag([1e-4, 1e-4, 1e-4]), known)
    estimator = TopologicalMcl(
        p_stay=0.2, p_skip=0.2, p_turn=0.0, sigma_l_m=0.3, particles_per_node=100, estimate="mean"
    )
    estimator.reset(prior, np.random.default_rng(0))
    for i in range(50):
        estimator.step(frame(i))
    belief = estimator._summary({})
    assert belief.mean[0] == pytest.approx(140.0, abs=3.0)
    # 50 nodes, each with variance 0.4 of 4 m^2
    assert belief.covariance[0, 0] == pytest.approx(50 * 0.4 * 4.0, rel=0.35)


@pytest.mark.parametrize("options", [{}, PAPER], ids=["default", "paper"])
def test_localizes_globally_on_a_clear_route(options):
    recording, prior = place_route()
    lost = dataclasses.replace(prior, mean=None, covariance=None)
    found = run(TopologicalMcl(**options), recording, lost, np.random.default_rng(0), ["ess"])
    errors = np.hypot(*(found.means[:, :2] - recording.truth.poses[:, :2]).T)
    assert np.all(errors[5:] < 2.5)
    assert np.median(errors) < 1.0
    turns = np.abs(se2.wrap(found.means[5:, 2] - recording.truth.poses[5:, 2]))
    assert np.median(turns) < 0.3
    assert all(1.0 <= ess <= 160.0 + 1e-6 for ess in found.extras["ess"])


@pytest.mark.slow
def test_conforms():
    recording, prior = place_route()
    for options in ({}, PAPER, {"weighting": "M3", "scheme": "residual", "n_nearest": 2}):
        results = check_estimator(lambda o=options: TopologicalMcl(**o), recording, prior)
        assert not [r for r in results if not r.passed]


@pytest.mark.parametrize("injection", [0.05, 0.0])
def test_a_kidnapped_robot_is_found_again_with_injection_only(injection):
    recording, prior = place_route()
    rows = np.concatenate([np.arange(12), np.arange(25, 40)])
    taken = places.resequence(recording, rows)
    lost = dataclasses.replace(prior, mean=None, covariance=None)
    estimator = TopologicalMcl(injection=injection, sigma_l_m=1.0)
    found = run(estimator, taken, lost, np.random.default_rng(1))
    errors = np.hypot(*(found.means[:, :2] - taken.truth.poses[:, :2]).T)
    assert np.all(errors[8:12] < 2.5)
    assert np.all(errors[-5:] < 2.5) == (injection > 0.0)


def test_odd_maps_have_defined_answers():
    lone = from_arrays([[3.0, 4.0]], [[1.0, 0.0]])
    for options in ({}, PAPER):
        estimator = started(lone, **options)
        for i in range(3):
            belief = estimator.step(frame(i, descriptor=[0.0, 1.0]))
        np.testing.assert_allclose(belief.mean[:2], [3.0, 4.0])
        assert np.isfinite(belief.covariance).all()
        parts = started(line_map(8, join=False), **options)  # every node is a part of its own
        for i in range(4):
            belief = parts.step(frame(i, descriptor=np.eye(8)[5]))
        assert belief.mean[0] == pytest.approx(10.0, abs=2.0)
        same = from_arrays(np.ones((5, 2)), np.eye(5))  # all in one place
        estimator = started(same, **options)
        for i in range(4):
            belief = estimator.step(frame(i, 50.0, descriptor=np.eye(5)[2]))
        np.testing.assert_allclose(belief.mean[:2], 1.0)
        twice = np.repeat(np.column_stack([2.0 * np.arange(5), np.zeros(5)]), 2, axis=0)
        estimator = started(from_arrays(twice, np.eye(10)), **options)
        for i in range(5):
            belief = estimator.step(frame(i, 2.0, descriptor=np.eye(10)[min(2 * i, 9)]))
        assert np.isfinite(belief.mean).all()


def test_bad_descriptors_are_refused_or_passed_over():
    estimator = started(line_map())
    with pytest.raises(InputError, match="have 10 numbers"):
        estimator.step(frame(0, descriptor=np.ones(9)))
    before = estimator.step(frame(0, 0.0, descriptor=np.eye(10)[3]))
    told = estimator.step(frame(1, 0.0, descriptor=np.full(10, np.nan)))
    assert told.extras["status"] == "descriptor not finite"
    np.testing.assert_allclose(told.mean, before.mean, atol=1e-12)
    assert "status" not in estimator.step(frame(2, descriptor=np.eye(10)[4])).extras
    suite = {"lidar3d": LIDAR}
    blank = np.full((16, 360), np.inf, np.float32)
    with pytest.raises(InputError, match="come from elsewhere"):
        started(line_map(), sensors=suite).step(frame(0, cloud_ranges_m=blank))
    known = from_recording(ring_run(), "ring_key", 1.0)
    belief = started(known, sensors=suite).step(frame(0, cloud_ranges_m=blank))
    assert belief.extras["status"] == "empty cloud"


def test_bad_settings_and_a_missing_map_are_named(tmp_path):
    with pytest.raises(InputError, match="p_stay"):
        TopologicalMcl(p_stay=0.6, p_skip=0.6)
    for known in (None, np.eye(3)):
        with pytest.raises(InputError, match="topological map"):
            started(known)
    with pytest.raises(InputError, match=r"no\.npz"):
        started(None, map_path=str(tmp_path / "no.npz"))
    with pytest.raises(InputError, match=r"particles_per_node=1000000000000 .* at most 10000000"):
        started(from_recording(ring_run(), "ring_key", 1.0), particles_per_node=10**12)


def test_the_wheels_carry_a_registered_pose_over_a_gap():
    run_ = ring_run()
    truth = run_.truth.poses
    known = from_recording(run_, "ring_key", 1.0)
    known = dataclasses.replace(  # distinct places in a room that looks alike
        known, descriptor="", descriptors=known.positions_m.astype(np.float32)
    )
    suite = {"lidar3d": LIDAR}
    prior = Prior(run_.robot, suite, truth[0], np.diag([0.01, 0.01, 0.01]), known)
    estimator = TopologicalMcl(particles_per_node=50)
    estimator.reset(prior, np.random.default_rng(0))
    spread = 0.0
    shut_in = np.full((16, 360), 0.5, np.float32)  # all is near: no outline to register
    for i, frame_ in enumerate(run_.frames()):
        place = truth[i, :2].astype(np.float32)
        seen = with_reading(frame_, "place", descriptor=place)
        if i in (20, 21):
            seen = with_reading(seen, "lidar3d", ranges_m=shut_in)
        if i == 22:
            seen = blind(seen)
        belief = estimator.step(seen)
        assert (belief.extras.get("refinement") == "ok") == (i not in (20, 21, 22))
        np.testing.assert_allclose(belief.mean[:2], truth[i, :2], atol=1e-3)
        assert abs(se2.wrap(belief.mean[2] - truth[i, 2])) < 1e-3
        assert np.all(np.linalg.eigvalsh(belief.covariance) > 0.0)
        if i in (20, 21, 22):  # less sure at each
            assert np.trace(belief.covariance) > spread
        spread = np.trace(belief.covariance)


def test_turns_are_those_between_outlines():
    run_ = ring_run()
    outline = run_.log("lidar3d")["ranges_m"][5, 8]
    for beams in (0, 17, -120):
        turned = np.roll(outline, -beams)  # the robot turned counter-clockwise
        best = find_turns_rad(turned, outline)[0]
        assert best == pytest.approx(math.radians(beams), abs=1e-6)
    assert find_turns_rad(np.full(360, 2.0, np.float32), outline)


def test_refinement_finds_the_pose_from_a_node_nearby():
    run_ = ring_run()
    known = from_recording(run_, "ring_key", 1.0)
    refiner = Refiner(known, LIDAR)
    noise = np.random.default_rng(0)
    for row in (2, 9, 23):
        truth = run_.truth.poses[row]
        node = int(np.argmin(np.hypot(*(known.positions_m - truth[:2]).T)))
        noisy = run_.log("lidar3d")["ranges_m"][row] + noise.normal(0, 0.01, (16, 360)).astype(
            np.float32
        )
        found = refiner.refine(noisy, node, [])
        off = np.array(found.pose) - truth
        # a square room looks the same after a quarter turn: the heading of the node's is tried
        # first only if the correlation says so, so either answer has the walls in place
        quarter = abs(se2.wrap(off[2])) > 0.5
        assert quarter or np.hypot(*off[:2]) < 0.02
        assert found.status == "ok"
        assert np.all(np.linalg.eigvalsh(found.covariance) > 0.0)
    blank = refiner.refine(np.full((16, 360), np.inf, np.float32), 0, [1])
    assert blank.pose is None
    assert blank.status == "empty"
    with pytest.raises(InputError, match="720 azimuths"):
        Refiner(known, dataclasses.replace(LIDAR, n_azimuths=720))
