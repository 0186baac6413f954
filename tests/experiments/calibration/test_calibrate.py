"""Calibration against robots whose slip and geometry are known."""

import dataclasses

import numpy as np
import pytest

from experiments.calibration.calibrate import calibrate_recordings, from_wheel_truth
from experiments.calibration.end_pose_model import EndPoseModel, knots
from experiments.calibration.end_poses import Manoeuvre, from_end_poses
from experiments.papers.puzzlebot2024.descent import convergence, report_gradient_descent
from experiments.papers.puzzlebot2024.settings import NOMINAL
from experiments.papers.puzzlebot2024.study import (
    Arm,
    arms,
    calibrate_once,
    ideal,
)
from experiments.runs.seeds import stream
from sim.errors import InputError
from sim.robot.kinematic import run_batch
from sim.routes.route import TABLE_1, OpenLoop
from sim.sensors import Encoder
from sim.simulate import Member, record
from sim.worlds.world import World


def slipping(k, geometry=False):
    """The robot with kr = 1.5 k, kl = 0.5 k, and on request errors of 5 % in gains and track."""
    errors = {
        "bias_right": 0.05,
        "bias_left": -0.05,
        "track_m": 1.05 * NOMINAL.track_m,
        "nominal_track_m": NOMINAL.track_m,
    }
    return dataclasses.replace(NOMINAL, kr=1.5 * k, kl=0.5 * k, **(errors if geometry else {}))


OPEN = World("open", np.zeros((0, 4)), np.zeros((0, 2)))


def recordings(robot, n, route, physics="kinematic", rate_hz=20.0, first_seed=0):
    return [
        record(
            OPEN,
            Member(
                robot,
                {"encoder": Encoder(rate_hz=rate_hz)},
                route,
                {axis: stream(seed, axis) for axis in ("slip", "sensors")},
            ),
            physics=physics,
            rays="exact",
        )
        for seed in range(first_seed, first_seed + n)
    ]


@pytest.mark.parametrize("k", [1e-5, 1e-4, 1e-3])
def test_wheel_truth_finds_both_wheels_at_any_k(k):
    robot = dataclasses.replace(NOMINAL, kr=k, kl=3 * k)
    batch = run_batch(robot, OpenLoop(segments=((0.5, 0.3, 8.0),)), 100, np.random.default_rng(0))
    encoder, ground = (np.diff(a, axis=1).reshape(-1, 2) for a in (batch.encoder_m, batch.ground_m))
    found = from_wheel_truth(encoder, ground, interval_s=0.05, geometry=False)
    assert found.kr.value == pytest.approx(k, rel=0.05)
    assert found.kl.value == pytest.approx(3 * k, rel=0.05)
    assert found.kr.high / found.kr.low < 1.1


@pytest.mark.bullet
def test_wheel_truth_on_the_engines_recordings():
    robot = slipping(1e-4)
    found = calibrate_recordings(
        recordings(robot, 3, OpenLoop(segments=((0.5, 0.2, 15.0),)), "bullet")
    )
    assert found.kr.low <= robot.kr <= found.kr.high
    assert found.kl.low <= robot.kl <= found.kl.high
    assert found.track_m.value == pytest.approx(0.19, rel=1e-3)


@pytest.mark.slow
def test_gain_and_track_errors_are_found_jointly():
    robot = slipping(1e-4, geometry=True)
    for result in calibrate_once(Arm(3, robot, TABLE_1))[:2]:
        assert result.kr.value == pytest.approx(robot.kr, rel=0.35)
        assert result.bias_right.value == pytest.approx(0.05, abs=0.01)
        assert result.bias_left.value == pytest.approx(-0.05, abs=0.01)
        assert result.track_m.value == pytest.approx(robot.track_m, rel=0.01)


def test_ignoring_a_gain_error_spoils_k():
    """Why the joint arm is needed: the same runs, calibrated with the nominal geometry."""
    rng = np.random.default_rng(5)
    robot = slipping(1e-4, geometry=True)
    runs = [
        Manoeuvre(route.profile(NOMINAL), run_batch(robot, route, 20, rng).end_poses)
        for route in TABLE_1.values()
    ]
    blind = from_end_poses(runs, NOMINAL, np.random.default_rng(0), geometry=False)
    assert blind.kr.value + blind.kl.value > 1.5 * (robot.kr + robot.kl)


@pytest.mark.parametrize("name", ["linear_2", "linear_4", "angular_3", "square"])
def test_the_models_end_poses_are_those_of_the_tick_by_tick_robot(name):
    """Two dozen knots stand for 300 ticks a second, biases and lag included."""
    square = OpenLoop(segments=((0.5, 0.0, 1.0), (0.0, 0.8, 2.0)) * 3)
    route, robot = {**TABLE_1, "square": square}[name], slipping(1e-3, geometry=True)
    rng = np.random.default_rng(4)
    runs = run_batch(robot, route, 4000, rng)
    model = EndPoseModel(route.profile(NOMINAL), NOMINAL, rng, "sampled", 256)
    seen = model.coordinates(runs.end_poses)
    mean, covariance = model.moments(robot.slip_variance_per_m, robot.slip_bias, robot.track_m)
    off = (seen.mean(axis=0) - mean) / np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(off, 0.0, atol=0.06)
    ratio = np.linalg.eigvals(np.linalg.solve(covariance, np.cov(seen.T))).real
    np.testing.assert_allclose(ratio, 1.0, atol=0.1)


@pytest.mark.parametrize("route", [TABLE_1["linear_2"], OpenLoop(segments=((0.4, 0.6, 5.0),))])
def test_the_analytic_covariance_is_that_of_the_odometry_filter(route):
    robot = slipping(1e-4)
    profile = route.profile(NOMINAL)
    model = EndPoseModel(profile, NOMINAL, np.random.default_rng(0), "linearised", 2)
    mean, covariance = model.moments(robot.slip_variance_per_m, np.zeros(2), NOMINAL.track_m)
    covariances = ideal(route, robot.kr, robot.kl).covariances
    np.testing.assert_allclose(mean, route.ideal_end(), atol=1e-6)
    spread = np.sqrt(np.diag(covariances[-1]))
    np.testing.assert_allclose(
        (covariance - covariances[-1]) / np.outer(spread, spread), 0, atol=0.01
    )


@pytest.mark.parametrize("method", ["sampled", "linearised"])
def test_gain_errors_scale_the_spread_of_the_end_poses(method):
    """On the ground the variance is k |ds| / (1 + bias)^2; a small k keeps the model linear."""
    route, robot = OpenLoop(segments=((0.4, 0.6, 5.0),)), slipping(1e-6, geometry=True)
    robot = dataclasses.replace(robot, bias_right=0.5, bias_left=0.5)
    rng = np.random.default_rng(6)
    runs = run_batch(robot, route, 4000, rng)
    model = EndPoseModel(route.profile(NOMINAL), NOMINAL, rng, method, 256)
    seen = model.coordinates(runs.end_poses)
    _, covariance = model.moments(robot.slip_variance_per_m, robot.slip_bias, robot.track_m)
    ratio = np.linalg.eigvals(np.linalg.solve(covariance, np.cov(seen.T))).real
    np.testing.assert_allclose(ratio, 1.0, atol=0.12)


def test_a_plateau_has_no_turning_points():
    for name, route in TABLE_1.items():
        commands = NOMINAL.wheel_speeds(*route.profile(NOMINAL).T)
        assert len(knots(commands)) == 25, name


def test_the_linearised_likelihood_overestimates_where_headings_scatter():
    truth = slipping(1e-3)
    sampled, linearised = calibrate_once(Arm(2, truth, TABLE_1))[1:]
    assert linearised.kl.value > 1.4 * truth.kl
    assert sampled.kl.value == pytest.approx(truth.kl, rel=0.35)


def test_end_poses_from_recordings_group_by_their_commands():
    robot = slipping(1e-4)
    runs = recordings(robot, 20, TABLE_1["linear_4"])
    runs += recordings(robot, 20, TABLE_1["angular_5"], first_seed=50)
    found = calibrate_recordings(runs, "end_poses", geometry=False)
    assert found.n_used == 40
    assert found.kr.value + found.kl.value == pytest.approx(robot.kr + robot.kl, rel=0.5)
    assert found.kr.high / found.kr.low < 8


def test_the_reports_descent_goes_to_one_half_whatever_the_data():
    rng = np.random.default_rng(0)
    for _ in range(5):
        ideal, real = rng.normal(size=2) * 5
        k = report_gradient_descent(ideal, real, 2.0, n_iterations=20_000)
        assert k[0] == 1.0
        assert k[-1] == pytest.approx(0.5, abs=1e-3)


def test_refusals_name_the_remedy():
    run = recordings(slipping(1e-4), 1, TABLE_1["linear_4"])[0]
    with pytest.raises(InputError, match="at least one"):
        calibrate_recordings([])
    with pytest.raises(InputError, match="end poses"):
        calibrate_recordings([run], "end_poses")
    with pytest.raises(InputError, match="no true wheel travel"):
        calibrate_recordings([dataclasses.replace(run, truth=None)])
    with pytest.raises(InputError, match="too short"):
        from_wheel_truth(np.ones((9, 2)), np.ones((9, 2)), interval_s=0.001)
    with pytest.raises(InputError, match="never rolled"):
        from_wheel_truth(np.ones((9, 2)), np.zeros((9, 2)), interval_s=0.05)


@pytest.mark.slow
def test_the_studies_are_composed_of_table_1_and_robots_that_differ_in_slip():
    for arm in arms("coverage"):
        assert arm.routes == TABLE_1
        assert dataclasses.asdict(arm.robot) == pytest.approx(dataclasses.asdict(slipping(arm.k_m)))
    for arm in arms("calibration"):
        robot = dataclasses.replace(slipping(arm.k_m, arm.joint), nominal_track_m=NOMINAL.track_m)
        assert dataclasses.asdict(arm.robot) == pytest.approx(dataclasses.asdict(robot))


def test_the_reports_plots_show_its_own_descent():
    """As its programs compute it, with the forward difference of their gradient."""
    for (_, part), v in zip(
        convergence().groupby("data", sort=False), ((2.34674 - 2.445330811) / 5.0,
        (1.06419 - 2.312493295) / 3.0), strict=True,
    ):  # fmt: skip
        k, errors = 1.0, []
        for _ in range(101):
            errors.append((2.0 * k * v - v) ** 2)
            k -= 0.01 * ((2.0 * (k + 1e-5) * v - v) ** 2 - errors[-1]) / 1e-5
        np.testing.assert_allclose(part["error"], errors, rtol=1e-4)
