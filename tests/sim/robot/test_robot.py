import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim.errors import InputError
from sim.robot.arc import TravelWindow, arc_increment, arc_increment_jacobian
from sim.robot.drive import DifferentialDrive, RobotGeometry
from sim.robot.kinematic import run_batch
from sim.robot.slip import wheel_errors, wheel_variances
from sim.routes.route import OpenLoop

DT_S = 1 / 300
travel = st.tuples(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0)).map(np.array)


def drive(**options):
    return DifferentialDrive(**{"wheel_radius_m": 0.05, "track_m": 0.19, **options})


@given(travel)
def test_arc_agrees_with_many_small_steps(wheels):
    n, pose = 4000, np.zeros(3)
    heading = (np.arange(n) + 0.5) / n * (wheels[0] - wheels[1]) / 0.4
    forward = (wheels[0] + wheels[1]) / 2 / n
    pose[:2] = np.sum(forward * np.cos(heading)), np.sum(forward * np.sin(heading))
    pose[2] = (wheels[0] - wheels[1]) / 0.4
    assert np.allclose(arc_increment(wheels, 0.4), pose, atol=2e-5)


@given(travel)
def test_arc_jacobian_matches_finite_differences(wheels):
    exact, step = arc_increment_jacobian(wheels, 0.3), 1e-6
    for i in range(2):
        d = np.zeros(2)
        d[i] = step
        numeric = (arc_increment(wheels + d, 0.3) - arc_increment(wheels - d, 0.3)) / (2 * step)
        assert np.allclose(numeric, exact[:, i], atol=1e-7)


def test_right_wheel_turns_counter_clockwise():
    assert arc_increment([0.1, 0.0], 0.2)[2] > 0
    assert arc_increment_jacobian([0.1, 0.1], 0.2)[2].tolist() == pytest.approx([5.0, -5.0])


def test_slip_law_over_a_batch():
    """Var(encoder - ground) = k |ds|, white, uncorrelated between wheels, at any interval."""
    robot = drive(kr=1e-4, kl=3e-4)
    route = OpenLoop(segments=((0.5, 0.0, 2.0),))
    runs = run_batch(robot, route, 400, np.random.default_rng(1), sample_s=DT_S)
    grounds, encoders = np.moveaxis(runs.ground_m, 1, 0), np.moveaxis(runs.encoder_m, 1, 0)
    for every in (1, 15):
        g = np.diff(grounds[::every], axis=0)
        e = np.diff(encoders[::every], axis=0) - g
        k = np.sum(e**2, axis=(0, 1)) / np.sum(np.abs(g), axis=(0, 1))
        assert k == pytest.approx([1e-4, 3e-4], rel=0.03)
        flat = e.reshape(-1, 2)
        assert abs(np.corrcoef(flat.T)[0, 1]) < 0.02
        lag = [np.corrcoef(e[1:, :, i].ravel(), e[:-1, :, i].ravel())[0, 1] for i in (0, 1)]
        assert np.max(np.abs(lag)) < 0.03
    # The encoder follows the command, the ground travel wanders by about sqrt(k s).
    wander = np.std(encoders[-1] - grounds[-1], axis=0)
    assert wander == pytest.approx(np.sqrt(np.array([1e-4, 3e-4]) * 1.0), rel=0.12)
    assert np.std(encoders[-1], axis=0).max() < 0.45 * wander.max()


def test_wheel_errors_have_variance_k_ds():
    rng = np.random.default_rng(2)
    travel = np.tile([0.04, -0.01], (50_000, 1))
    errors = wheel_errors(travel, [1e-4, 3e-4], rng)
    assert errors.shape == travel.shape
    assert np.var(errors, axis=0) == pytest.approx([4e-6, 3e-6], rel=0.03)
    assert np.abs(np.mean(errors, axis=0)).max() < 4 * np.sqrt(4e-6 / len(travel))


def test_slip_and_wheel_errors_are_one_law():
    """From rest, before the lag reacts, a tick's encoder error is that of `wheel_errors`."""
    rolling = 0.002, -0.001
    slip = drive(kr=1e-4, kl=3e-4).start_slip(DT_S, np.random.default_rng(4))
    errors = wheel_errors(rolling, [1e-4, 3e-4], np.random.default_rng(4))
    assert list(slip.advance(rolling)) == (rolling + errors).tolist()


def driven(robot, n_ticks):
    """Rolling and encoder increments (n, 2) of wheels that are commanded 0.5 m/s."""
    slip, rows = robot.start_slip(DT_S, np.random.default_rng(0)), []
    for _ in range(n_ticks):
        rolling = tuple((0.5 - correction) * DT_S for correction in slip.correction_mps)
        rows.append((rolling, slip.advance(rolling)))
    return np.moveaxis(rows, 1, 0)


def test_bias_makes_the_encoder_read_more():
    ground, encoder = driven(drive(bias_right=0.05), 3000).sum(axis=1)
    assert (encoder / ground).tolist() == pytest.approx([1.05, 1.0])
    assert encoder[0] == pytest.approx(5.0, rel=2e-3)  # closed on the encoder, but for the lag


@pytest.mark.parametrize("factor", [0.34, 3.0])
def test_bias_up_to_a_factor_of_three_settles(factor):
    """The wheel's loop, closed on the encoder, brings the encoder to the command."""
    _, read = driven(drive(bias_right=factor - 1.0), 1500)
    assert (read[-1] / DT_S).tolist() == pytest.approx([0.5, 0.5])


def test_nominal_geometry_turns_commands_into_wheel_speeds():
    robot = DifferentialDrive(
        wheel_radius_m=0.05, track_m=0.2, nominal_wheel_radius_m=0.04, nominal_track_m=0.1
    )
    assert robot.nominal == RobotGeometry(0.04, 0.1)
    rates = robot.wheel_speeds(0.4, 2.0) / 0.05
    assert (rates * 0.04).tolist() == pytest.approx([0.4 + 0.1, 0.4 - 0.1])
    right = DifferentialDrive(wheel_radius_m=0.05, track_m=0.2)
    assert right.nominal == RobotGeometry(0.05, 0.2)
    assert right.wheel_speeds(0.4, 2.0).tolist() == [0.4 + 0.2, 0.4 - 0.2]


def test_pulses_are_counted_by_the_formula():
    """Travel per pulse is 2 pi r / (pulses * gear), decristoforis2020, eq. (1)."""
    robot = DifferentialDrive(
        wheel_radius_m=0.05, track_m=0.19, encoder_pulses_per_turn=13, gear_ratio=34.0
    )
    quantum = 2 * math.pi * 0.05 / (13 * 34)
    assert robot.encoder_quantum_m == pytest.approx(quantum)
    read = robot.encoder_reading(np.array([[100.5, -0.5], [0.25, 441.0001]]) * quantum)
    np.testing.assert_allclose(read / quantum, [[100, -1], [0, 441]], atol=1e-9)
    turn = robot.encoder_reading(np.array([2 * math.pi * 0.05 + 1e-9] * 2))
    assert turn / quantum == pytest.approx([442, 442])


def test_counts_become_metres_by_the_nominal_radius():
    """The wheel's angle is true, and the radius that makes it metres is the controller's."""
    robot = DifferentialDrive(
        wheel_radius_m=0.05,
        track_m=0.19,
        nominal_wheel_radius_m=0.06,
        encoder_pulses_per_turn=100,
        gear_ratio=2.0,
    )
    turns = np.array([1.503, 0.2511])
    read = robot.encoder_reading(turns * 2 * math.pi * 0.05)
    assert (read / (2 * math.pi * 0.06) * 200).tolist() == pytest.approx([300, 50])


def test_a_window_of_no_time_nets_nothing():
    window = TravelWindow(0.0)
    for travel_m in ([0.1, -0.2], [-0.3, 0.1]):
        np.testing.assert_array_equal(window.push(0.1, travel_m), np.abs(travel_m))


def test_travel_window_does_not_inflate_travel_by_encoder_noise():
    """At k <= 1e-4 m and 75 Hz the sum of |ds| stays within 2 % of the distance, crawling."""
    rng = np.random.default_rng(3)
    dt, speed, k = 1 / 75, 0.02, 1e-4
    true = np.full((30_000, 2), speed * dt)
    noisy = true + np.sqrt(k * true) * rng.standard_normal(true.shape)
    window = TravelWindow(0.05)
    netted = sum(window.push(dt, row) for row in noisy)
    assert netted == pytest.approx(true.sum(axis=0), rel=0.02)
    raw = np.abs(noisy).sum(axis=0)
    assert np.all(raw > 1.02 * netted), "the window must be what keeps the sum down"


def test_travel_window_is_exact_for_even_motion_and_unequal_frames():
    window = TravelWindow(0.05)
    total = np.zeros(2)
    for duration in [0.01, 0.03, 0.02, 0.1, 0.005] * 20:
        total += window.push(duration, np.array([0.4, -0.2]) * duration)
    assert total.tolist() == pytest.approx([0.4 * 3.3, 0.2 * 3.3])
    assert window.push(0.0, np.array([0.1, -0.1])).tolist() == [0.1, 0.1]


def test_wheel_variances_are_k_times_travel():
    assert wheel_variances([-2.0, 1.0], 1e-4, 1e-5).tolist() == pytest.approx([2e-4, 1e-5])


@pytest.mark.parametrize(
    "change",
    [
        {"kr": -1.0},
        {"kl": math.nan},
        {"track_m": 0.0},
        {"bias_left": 2.1},
        {"bias_right": -0.7},
        {"bias_right": math.nan},
        {"kr": math.inf},
        {"nominal_track_m": 0.0},
        {"nominal_wheel_radius_m": math.nan},
        {"encoder_pulses_per_turn": -1},
        {"gear_ratio": 0.0},
        {"gear_ratio": 34.0},  # without pulses
        {"encoder_pulses_per_turn": 13, "encoder_tick_m": 1e-3},
    ],
)
def test_impossible_robots_are_refused(change):
    with pytest.raises(InputError, match=f"robot.{next(iter(change))}"):
        DifferentialDrive(**{"wheel_radius_m": 0.05, "track_m": 0.2, **change})


def test_impossible_beliefs_are_refused():
    with pytest.raises(InputError, match=r"prior\.track_m"):
        RobotGeometry(0.05, -1.0)
