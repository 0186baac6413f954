"""Open-loop commands keep their promise of distance and angle within the robot's limits."""

import numpy as np
import pytest

from sim.errors import InputError
from sim.robot.arc import arc_increment
from sim.robot.base import TICK_S
from sim.robot.drive import DifferentialDrive
from sim.routes.route import TABLE_1, GoToPoints, OpenLoop, Tour
from sim.se2 import chain
from sim.worlds.world import World

ROBOT = DifferentialDrive(wheel_radius_m=0.05, track_m=0.18)
ROUTES = {
    **TABLE_1,
    "short": OpenLoop(segments=((0.5, 0.0, 0.1),)),
    "arc": OpenLoop(segments=((0.3, 0.7, 4.0),)),
    "reverse": OpenLoop(segments=((-0.4, 0.2, 1.0),)),
    "square": OpenLoop(segments=((0.5, 0.0, 2.0), (0.0, np.pi / 2, 1.0)) * 4),
    "pause": OpenLoop(segments=((0.5, 0.0, 1.0), (0.0, 0.0, 0.5), (0.5, 0.0, 1.0))),
}


@pytest.mark.parametrize("name", ROUTES)
def test_promised_distance_and_angle_are_exact(name):
    route = ROUTES[name]
    profile = route.profile(ROBOT)
    promised = sum(np.array(s[:2]) * s[2] for s in route.segments)
    np.testing.assert_allclose(profile.sum(axis=0) * TICK_S, promised, atol=1e-12)


@pytest.mark.parametrize("name", ROUTES)
def test_wheels_stay_within_the_acceleration(name):
    robot = DifferentialDrive(wheel_radius_m=0.05, track_m=0.18, max_acceleration_mps2=0.8)
    wheels = robot.wheel_speeds(*ROUTES[name].profile(robot).T)
    change = np.diff(wheels, axis=0, prepend=0.0, append=0.0) / TICK_S
    assert np.abs(change).max() <= 0.8 * (1 + 1e-9)
    if name == "linear_1":
        assert np.abs(change).max() > 0.79  # the limit is used


@pytest.mark.parametrize("name", ROUTES)
def test_ideal_poses_end_where_the_arcs_end(name):
    start = np.array([1.0, -2.0, 0.4])
    v, omega = ROUTES[name].profile(ROBOT).T
    travel = TICK_S * np.stack([v + omega, v - omega], axis=1)
    poses = chain(arc_increment(travel, 2.0), start)
    np.testing.assert_allclose(poses[-1], ROUTES[name].ideal_end(start), atol=1e-9)
    np.testing.assert_array_equal(poses[0], start)


def test_profile_follows_a_trapezoid_and_ends_at_rest():
    profile = TABLE_1["linear_1"].profile(ROBOT)
    v = profile[:, 0]
    middle_s = (np.arange(len(v)) + 0.5) * TICK_S
    expected = np.clip(np.minimum(middle_s, 2.5 - middle_s), 0.0, 0.5)
    np.testing.assert_allclose(v, expected, atol=1e-9)
    assert len(v) == 810  # 2 s, a ramp of 0.5 s and 0.2 s of rest
    np.testing.assert_array_equal(profile[-60:], 0.0)


def test_same_velocity_joins_and_another_passes_through_rest():
    joined = OpenLoop(segments=((0.5, 0.0, 1.0), (0.5, 0.0, 1.0)))
    np.testing.assert_allclose(joined.profile(ROBOT), TABLE_1["linear_1"].profile(ROBOT))
    mixed = OpenLoop(segments=((0.5, 0.0, 1.0), (0.5, 0.5, 1.0)))
    second_s = mixed.edges_s(ROBOT)[1]
    assert second_s == pytest.approx(1.5)
    tick = round(second_s / TICK_S)
    assert np.abs(mixed.profile(ROBOT)[tick - 1 : tick + 1, 0]).max() < 0.5 * TICK_S * 2


def test_the_dropped_case_turns_five_radians():
    np.testing.assert_allclose(TABLE_1["angular_3"].ideal_end(), [0.0, 0.0, 5.0], atol=1e-12)
    assert len(TABLE_1) == 9


def test_tick_length_does_not_change_the_promise():
    for dt_s in (1 / 300, 0.01, 0.037):
        total = ROUTES["arc"].profile(ROBOT, dt_s).sum(axis=0) * dt_s
        np.testing.assert_allclose(total, [1.2, 2.8], atol=1e-12)


@pytest.mark.parametrize(
    ("segments", "word"),
    [
        ((), "empty"),
        (((0.5, 0.0),), r"segments\[0\]"),
        (((0.5, 0.0, -1.0),), "positive duration"),
        (((0.5, float("nan"), 1.0),), r"segments\[0\] must be a list of"),
        ((0.5, 0.0, 1.0), r"segments\[0\]"),
    ],
)
def test_bad_segments_are_named_by_their_place(segments, word):
    with pytest.raises(InputError, match=word):
        OpenLoop(segments=segments)


SQUARE = {
    "points": ((1.0, 0.0), (1.0, 1.0)),
    "speed_mps": 0.4,
    "turn_rate_radps": 0.6,
    "gain_distance": 1.0,
    "gain_bearing": 2.0,
    "turn_above_rad": 0.1,
    "tolerance_m": 0.02,
}


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"points": ()}, r"route.points must be at least one point \[x, y\]"),
        ({"points": ((1.0, "left"),)}, "route.points"),
        ({"points": ((1.0, float("nan")),)}, "route.points"),
        ({"tolerance_m": 0.0}, "route.tolerance_m must be a positive number"),
        ({"feedback": "lidar"}, "route.feedback must be truth, odometry or a mapping.*'lidar'"),
        ({"feedback": {"kr": 1e-4}}, "route.feedback must be truth, odometry or a mapping"),
    ],
)
def test_bad_points_gains_and_feedback_are_named(change, line):
    with pytest.raises(InputError, match=line):
        GoToPoints(**{**SQUARE, **change})
    if "feedback" in change:
        with pytest.raises(InputError, match=line):
            Tour(**change)


def test_points_are_of_the_frame_of_the_start_pose():
    world = World(
        "open", np.zeros((0, 4)), np.zeros((0, 2)), start_pose=np.array([2.0, 1.0, np.pi])
    )
    _, driver = GoToPoints(**SQUARE).start(world, ROBOT)
    v, omega = driver.command(0, np.array([2.0, 1.0, np.pi]))
    assert v > 0.0
    assert omega == pytest.approx(0.0)
    v, omega = driver.command(6, np.array([1.0, 1.0, np.pi]))  # at the first; the next is left
    assert omega > 0.0


def test_a_point_never_reached_leaves_the_route_incomplete():
    world = World("open", np.zeros((0, 4)), np.zeros((0, 2)))
    start, driver = GoToPoints(**SQUARE).start(world, ROBOT)
    driver.command(0, start)
    assert driver.trouble is None
    driver.command(6 * 300 * 60, start)
    assert driver.trouble == "incomplete"


def test_a_robot_that_rolls_past_its_goal_comes_to_rest():
    world = World("open", np.zeros((0, 4)), np.zeros((0, 2)))
    tour = Tour(waypoints=((0.0, 0.0), (0.6, 0.0), (1.2, 0.0)), tolerance_m=1.0)
    pose, driver = tour.start(world, ROBOT)
    for tick in range(0, 300, 6):
        driver.command(tick, pose)  # at full speed
    pose[0] = 1.5
    commands = [driver.command(tick, pose) for tick in range(300, 1800, 6)]
    assert commands[0] is not None
    assert commands[-1] is None
    assert driver.trouble is None


def test_way_points_all_in_one_place_are_no_tour():
    world = World("open", np.zeros((0, 4)), np.zeros((0, 2)))
    tour = Tour(waypoints=((1.0, 2.0), (1.0, 2.0)), distance_m=1.0)
    with pytest.raises(InputError, match="way-points are all one place"):
        tour.start(world, ROBOT)
