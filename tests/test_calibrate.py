"""Calibration against robots whose slip and geometry are known."""

import dataclasses

import numpy as np
import pytest

from experiments.calibrate import (
    Manoeuvre,
    calibrate_recordings,
    from_end_poses,
    from_wheel_truth,
    report_gradient_descent,
)
from experiments.seeds import stream
from experiments.studies.puzzlebot2024 import NOMINAL, calibrate_once, slipping
from sim.errors import InputError
from sim.kinematic import run_batch
from sim.route import TABLE_1, OpenLoop
from sim.sensors import Encoder, SensorSuite
from sim.simulate import record
from sim.world import World

OPEN = World("open", np.zeros((0, 4)), np.zeros((0, 2)))


def recordings(robot, n, route, physics="kinematic", rate_hz=20.0, first_seed=0):
    return [
        record(
            OPEN,
            robot,
            SensorSuite(Encoder(rate_hz)),
            route,
            {axis: stream(seed, axis) for axis in ("slip", "sensors")},
            physics=physics,
            rays="exact",
        )
        for seed in range(first_seed, first_seed + n)
    ]


@pytest.mark.parametrize("k", [1e-5, 1e-4, 1e-3])
def test_wheel_truth_finds_both_wheels_at_any_k(k):
    robot = dataclasses.replace(NOMINAL, kr=k, kl=3 * k)
    batch = run_batch(robot, OpenLoop(((0.5, 0.3, 8.0),)), 100, np.random.default_rng(0))
    encoder, ground = (np.diff(a, axis=1).reshape(-1, 2) for a in (batch.encoder_m, batch.ground_m))
    found = from_wheel_truth(encoder, ground, interval_s=0.05, geometry=False)
    assert found.kr.value == pytest.approx(k, rel=0.05)
    assert found.kl.value == pytest.approx(3 * k, rel=0.05)
    assert found.kr.high / found.kr.low < 1.1


@pytest.mark.bullet
def test_wheel_truth_on_the_engines_recordings():
    robot = slipping(1e-4)
    found = calibrate_recordings(recordings(robot, 3, OpenLoop(((0.5, 0.2, 15.0),)), "bullet"))
    assert found.kr.covers(robot.kr)
    assert found.kl.covers(robot.kl)
    assert found.track_m.value == pytest.approx(0.19, rel=1e-3)


def test_gain_and_track_errors_are_found_jointly():
    robot = slipping(1e-4, geometry=True)
    for result in calibrate_once(1e-4, 3, geometry=True)[:2]:
        assert result.kr.value == pytest.approx(robot.kr, rel=0.35)
        assert result.bias_right.value == pytest.approx(0.05, abs=0.01)
        assert result.bias_left.value == pytest.approx(-0.05, abs=0.01)
        assert result.track_m.value == pytest.approx(robot.track_m, rel=0.01)


def test_ignoring_a_gain_error_spoils_k():
    """What the joint arm is for: the same runs, calibrated with the nominal geometry."""
    rng = np.random.default_rng(5)
    robot = slipping(1e-4, geometry=True)
    runs = [
        Manoeuvre.of_route(
            route,
            NOMINAL,
            run_batch(robot, route, 20, rng, nominal_track_m=NOMINAL.track_m).end_poses,
        )
        for route in TABLE_1.values()
    ]
    blind = from_end_poses(runs, NOMINAL, np.random.default_rng(0), geometry=False)
    assert blind.kr.value + blind.kl.value > 1.5 * (robot.kr + robot.kl)


def test_the_linearised_likelihood_overestimates_where_headings_scatter():
    sampled, linearised = calibrate_once(1e-3, 2, geometry=False)[1:]
    truth = slipping(1e-3)
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
