"""The kinematic robot obeys the slip law of sim.robot.drive, alone and in batches."""

import dataclasses

import numpy as np
import pytest

from sim.errors import InputError
from sim.robot.base import TICK_S
from sim.robot.drive import DifferentialDrive
from sim.robot.kinematic import KinematicBody, run_batch, wheel_commands
from sim.robot.slip import SLIP_TIME_CONSTANT_S, slip_increment
from sim.routes.route import TABLE_1, OpenLoop

IDEAL = DifferentialDrive(wheel_radius_m=0.05, track_m=0.18)
NOISY = dataclasses.replace(IDEAL, kr=2e-4, kl=1e-4, bias_right=0.05, bias_left=-0.03)
ROUTE = OpenLoop(segments=((0.5, 0.0, 1.0), (0.2, 0.9, 1.5), (0.0, -0.6, 1.0)))


def test_body_rolls_along_exact_arcs():
    body = KinematicBody(IDEAL, [1.0, 2.0, 0.3], dt_s=1.0)
    rolling = body.step(0.4, 0.1)
    np.testing.assert_array_equal(rolling, [0.4, 0.1])
    turn, radius = 0.3 / 0.18, 0.25 / (0.3 / 0.18)
    expected = [
        1.0 + radius * (np.sin(0.3 + turn) - np.sin(0.3)),
        2.0 - radius * (np.cos(0.3 + turn) - np.cos(0.3)),
        0.3 + turn,
    ]
    np.testing.assert_allclose(body.pose, expected, atol=1e-12)


def test_heading_is_not_wrapped():
    body = KinematicBody(IDEAL, np.zeros(3), dt_s=1.0)
    for _ in range(4):
        body.step(0.18, -0.18)
    assert body.pose[2] == pytest.approx(8.0)


@pytest.mark.parametrize("name", TABLE_1)
def test_without_slip_the_promise_is_kept(name):
    runs = run_batch(IDEAL, TABLE_1[name], 1, np.random.default_rng(0), start=[1, 2, 3])
    np.testing.assert_allclose(
        runs.end_poses[0], TABLE_1[name].ideal_end([1, 2, 3]), rtol=0, atol=1e-9
    )
    np.testing.assert_array_equal(runs.encoder_m, runs.ground_m)


def laws(robot):
    return (robot.kr, robot.bias_right), (robot.kl, robot.bias_left)


def test_batch_is_the_slip_law_tick_by_tick():
    runs = run_batch(NOISY, ROUTE, 2, np.random.default_rng(3), sample_s=0.1)
    rng = np.random.default_rng(3)
    profile = ROUTE.profile(NOISY)
    normals = rng.standard_normal((2, len(profile), 2))
    for run in range(2):
        body, lag, law = KinematicBody(NOISY, np.zeros(3)), np.zeros(2), laws(NOISY)
        encoder, ground = np.zeros(2), np.zeros(2)
        encoders = [encoder.copy()]
        for tick, velocity in enumerate(profile):
            rolled = body.step(*(NOISY.wheel_speeds(*velocity) - lag / TICK_S).tolist())
            for i in (0, 1):
                of_wheel = rolled[i], lag[i], law[i], normals[run, tick, i], 0.0
                read, lag[i] = slip_increment(*of_wheel, TICK_S / SLIP_TIME_CONSTANT_S)
                encoder[i] += read
            ground += rolled
            if (tick + 1) % 30 == 0:
                encoders.append(encoder.copy())
        np.testing.assert_allclose(runs.end_poses[run], body.pose, atol=1e-9)
        np.testing.assert_allclose(runs.ground_m[run, -1], ground, atol=1e-12)
        np.testing.assert_allclose(runs.encoder_m[run, : len(encoders)], encoders, atol=1e-12)


def test_variance_of_encoder_less_ground_is_k_times_travel():
    robot = dataclasses.replace(IDEAL, kr=3e-4, kl=1e-4)
    runs = run_batch(robot, TABLE_1["linear_1"], 2000, np.random.default_rng(5))
    error = np.diff(runs.encoder_m - runs.ground_m, axis=1)
    travel = np.abs(np.diff(runs.ground_m, axis=1)).sum(axis=(0, 1))
    ratio = (error**2).sum(axis=(0, 1)) / travel / [3e-4, 1e-4]
    np.testing.assert_allclose(ratio, 1.0, atol=0.03)
    assert abs(np.corrcoef(error[..., 0].ravel(), error[..., 1].ravel())[0, 1]) < 0.02


def test_encoder_follows_the_command_and_the_ground_wanders():
    robot = dataclasses.replace(IDEAL, kr=1e-4, kl=1e-4)
    runs = run_batch(robot, TABLE_1["linear_2"], 500, np.random.default_rng(6))
    ground, encoder = runs.ground_m[:, -1] - 2.5, runs.encoder_m[:, -1] - 2.5
    assert np.std(ground) == pytest.approx(np.sqrt(1e-4 * 2.5), rel=0.08)
    assert np.std(encoder) < 0.1 * np.std(ground)


def test_commands_use_the_nominal_track():
    robot = dataclasses.replace(IDEAL, nominal_track_m=0.36)
    nominal = wheel_commands(robot, ROUTE)
    turn = ROUTE.profile(robot)[:, 1]
    np.testing.assert_allclose(nominal[:, 0] - nominal[:, 1], turn * 0.36 * TICK_S, atol=1e-15)
    runs = run_batch(robot, TABLE_1["angular_1"], 1, np.random.default_rng(0))
    assert runs.end_poses[0, 2] == pytest.approx(3.0)  # twice the 1.5 rad asked for


def test_runs_do_not_depend_on_how_many_there_are():
    few = run_batch(NOISY, ROUTE, 2, np.random.default_rng(9))
    many = run_batch(NOISY, ROUTE, 900, np.random.default_rng(9))
    np.testing.assert_array_equal(few.poses, many.poses[:2])
    assert not np.array_equal(many.end_poses[0], many.end_poses[1])


def test_encoder_counts_are_quantised():
    robot = dataclasses.replace(NOISY, encoder_tick_m=1e-3)
    counts = run_batch(robot, ROUTE, 1, np.random.default_rng(1)).encoder_m / 1e-3
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-9)


def test_batch_reads_the_encoders_by_the_nominal_radius():
    robot = dataclasses.replace(IDEAL, nominal_wheel_radius_m=0.04)
    runs = run_batch(robot, TABLE_1["linear_1"], 1, np.random.default_rng(0))
    assert runs.encoder_m[0, -1] == pytest.approx([1.0, 1.0])  # as commanded
    assert runs.ground_m[0, -1] == pytest.approx([1.25, 1.25])  # by the true radius


@pytest.mark.parametrize("length_m", [0.0, 0.5])
def test_slip_of_both_wheels_together(length_m):
    """Its variance is that of the simulator's: q per metre, less what has not been forgotten."""
    q, travelled = 1e-4, 1.0
    robot = dataclasses.replace(IDEAL, forward_slip_m=q, forward_slip_length_m=length_m)
    runs = run_batch(robot, TABLE_1["linear_1"], 3000, np.random.default_rng(5))
    error = (runs.encoder_m - runs.ground_m)[:, -1]
    lasting = length_m * (1.0 - np.exp(-travelled / length_m)) if length_m else 0.0
    assert np.var(error[:, 0]) == pytest.approx(q * (travelled - lasting), rel=0.1)
    np.testing.assert_allclose(error[:, 0], error[:, 1], atol=1e-12)


def test_unmodelled_slip_is_refused():
    with pytest.raises(InputError, match="unmodelled_slip=0"):
        run_batch(
            dataclasses.replace(IDEAL, unmodelled_slip=0.1), ROUTE, 1, np.random.default_rng(0)
        )
