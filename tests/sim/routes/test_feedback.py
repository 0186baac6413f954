"""Routes steered by the true pose, or by the robot's odometry with its nominal geometry."""

import dataclasses
import re

import numpy as np
import pytest

from estimators.base import Prior, run
from estimators.odometry import Odometry
from experiments.runs.experiment import Experiment
from experiments.runs.seeds import stream
from sim import se2
from sim.errors import InputError
from sim.robot.arc import arc_increment
from sim.robot.drive import DifferentialDrive
from sim.routes.feedback import CONTROL_TICKS, OdometryFeedback
from sim.routes.route import OpenLoop, Tour
from sim.sensors import Encoder
from sim.simulate import Member, record
from sim.worlds.world import World

EMPTY = World("open", np.zeros((0, 4)), np.zeros((0, 2)))
PUZZLEBOT = DifferentialDrive(wheel_radius_m=0.05, track_m=0.19)
SLIPPING = dataclasses.replace(PUZZLEBOT, kr=1.5e-4, kl=5e-5)
SHORT = dataclasses.replace(PUZZLEBOT, nominal_track_m=0.44 * 0.19)
SQUARE = Experiment.compose(["route=square", "robot=puzzlebot"]).route()
TOUR = Tour(waypoints=((0, 0), (1.5, 0), (1.5, 1.0)))
CORNER = np.array(SQUARE.points[-1])


def drive(robot, route=SQUARE, physics="kinematic", seed=0):
    streams = {axis: stream(seed, axis) for axis in ("slip", "sensors")}
    sensors = {"encoder": Encoder(rate_hz=50.0)}
    return record(EMPTY, Member(robot, sensors, route, streams), physics=physics, rays="exact")


def steered_by(feedback, route=SQUARE):
    return dataclasses.replace(route, feedback=feedback)


def odometry(recording):
    """Poses (F, 3) by the estimator, with the geometry that the recording states."""
    prior = Prior(recording.robot, recording.sensors, recording.truth.poses[0], np.zeros((3, 3)))
    return run(Odometry(kr=0.0, kl=0.0), recording, prior, np.random.default_rng(0)).means


def test_without_a_word_on_feedback_the_driver_gets_the_truth():
    """A route of one's own has no attribute `feedback`; the bits are those of `truth`."""

    class Own:
        def start(self, world, robot):
            return TOUR.start(world, robot)

    assert TOUR.feedback == "truth"
    assert drive(SLIPPING, Own()).checksum == drive(SLIPPING, TOUR).checksum
    assert drive(SLIPPING, steered_by("odometry", TOUR)).checksum != drive(SLIPPING, TOUR).checksum


@pytest.mark.parametrize("route", [SQUARE, TOUR], ids=["square", "tour"])
def test_without_slip_odometry_is_as_good_as_the_truth(route):
    truth, reckoned = (
        drive(PUZZLEBOT, steered_by(feedback, route)).truth for feedback in ("truth", "odometry")
    )
    np.testing.assert_allclose(reckoned.poses, truth.poses, rtol=0, atol=1e-6)


@pytest.mark.parametrize("robot", [SLIPPING, SHORT], ids=["slipping", "short"])
def test_the_square_on_odometry_errs_as_odometry_does(robot):
    """The robot believes itself at the corner; what it is off is the error of its odometry."""
    recording = drive(robot, steered_by("odometry"), seed=1)
    true, believed = recording.truth.poses[-1, :2], odometry(recording)[-1, :2]
    assert recording.status == "ok"
    assert np.hypot(*(believed - CORNER)) <= SQUARE.tolerance_m
    off, error = true - CORNER, true - believed
    assert np.hypot(*(off - error)) <= SQUARE.tolerance_m
    assert np.hypot(*off) > 3.0 * SQUARE.tolerance_m


def test_the_square_on_the_truth_ends_at_its_corner():
    for robot in (SLIPPING, SHORT):
        recording = drive(robot, steered_by("truth"), seed=1)
        assert recording.status == "ok"
        off_m = np.hypot(*(recording.truth.poses[-1, :2] - CORNER))
        assert off_m <= SQUARE.tolerance_m + 2e-3  # the lag of the wheels rolls on a little


def test_odometry_is_reckoned_from_counts_at_the_control_rate():
    robot = dataclasses.replace(SHORT, encoder_pulses_per_turn=13, gear_ratio=2.0)
    start, rng = np.array([1.0, 2.0, 0.3]), np.random.default_rng(0)
    feedback, expected = OdometryFeedback(robot, start), start
    encoder, counted = np.zeros(2), np.zeros(2)
    for tick in range(10 * CONTROL_TICKS):
        if tick % CONTROL_TICKS == 0:
            reading = np.floor(encoder / robot.encoder_quantum_m) * robot.encoder_quantum_m
            step = arc_increment(reading - counted, 0.44 * 0.19)
            expected, counted = se2.compose(expected, step), reading
        believed = feedback.pose(tick, np.full(3, np.nan), encoder)
        np.testing.assert_allclose(believed, expected, atol=1e-12)
        encoder = encoder + rng.uniform(-0.01, 0.03, 2)


def turned(physics, **robot):
    """Radians turned of one commanded, and metres driven of one."""
    robot = dataclasses.replace(PUZZLEBOT, **robot)
    poses = drive(robot, OpenLoop(segments=((0.0, 0.5, 2.0),)), physics).truth.poses
    straight = drive(robot, OpenLoop(segments=((0.5, 0.0, 2.0),)), physics).truth.poses
    return poses[-1, 2] - poses[0, 2], straight[-1, 0] - straight[0, 0]


@pytest.mark.parametrize("physics", ["kinematic", pytest.param("bullet", marks=pytest.mark.bullet)])
def test_nominal_geometry_decides_what_becomes_of_a_command(physics):
    turn, way = turned(physics, nominal_track_m=0.44 * 0.19)
    assert (turn, way) == pytest.approx((0.44, 1.0), rel=0.01)
    turn, way = turned(physics, nominal_wheel_radius_m=0.04)
    assert (turn, way) == pytest.approx((1.25, 1.25), rel=0.01)


@pytest.mark.parametrize("physics", ["kinematic", pytest.param("bullet", marks=pytest.mark.bullet)])
@pytest.mark.parametrize("factor", [0.34, 3.0])
def test_wheels_biased_threefold_settle(physics, factor):
    robot = dataclasses.replace(PUZZLEBOT, bias_right=factor - 1.0, bias_left=factor - 1.0)
    recording = drive(robot, OpenLoop(segments=((0.15, 0.0, 8.0),), rest_s=3.0), physics)
    assert recording.status == "ok"
    assert recording.wheels.position_m[-1] == pytest.approx([1.2, 1.2], rel=0.01)
    assert recording.truth.poses[-1, 0] == pytest.approx(1.2 / factor, rel=0.01)


def test_recordings_state_the_nominal_geometry():
    assert drive(SHORT, TOUR).robot == SHORT.nominal


def test_a_square_from_the_configuration_on_the_robot_with_short_turns():
    experiment = Experiment.compose(
        ["study=puzzlebot2024/square_feedback", "robot=puzzlebot_short_turns", "robot.kr=0"]
    )
    assert experiment.robot().nominal.track_m == pytest.approx(0.44 * experiment.robot().track_m)
    assert experiment.route().feedback == "odometry"


ONBOARD = "route.feedback={_target_: estimators.laser.ekf_icp.EkfIcp, kr: 1e-4, kl: 1e-4}"


def test_an_estimator_on_board_steers_by_what_it_makes_of_the_recording():
    """It sees the Frames of the recording: run over it again, it has the same beliefs."""
    experiment = Experiment.compose(
        [
            *("world=room", "sensors=hokuyo", "route.distance_m=3", "robot.kr=1e-4"),
            *("robot.kl=1e-4", "simulation.physics=kinematic", ONBOARD),
        ]
    )
    experiment.check()
    believed = []

    def spied(*arguments):
        step = experiment.onboard(*arguments)
        return lambda frame: believed.append(step(frame)) or believed[-1]

    recording = record(
        experiment.world(),
        Member(
            experiment.robot(),
            experiment.sensors(),
            experiment.route(),
            {axis: np.random.default_rng(i) for i, axis in enumerate(("slip", "sensors"))},
            onboard=spied,
        ),
        physics="kinematic",
        rays="exact",
    )
    assert recording.status == "ok"
    truth = recording.truth
    step = experiment.onboard(truth.world, recording.robot, recording.sensors, truth.poses[0])
    again = [step(frame) for frame in recording.frames()]
    np.testing.assert_array_equal(again[: len(believed)], believed)
    assert np.hypot(*(again - truth.poses)[:, :2].T).max() < 0.02
    by_truth = experiment.with_values(route={**experiment.config["route"], "feedback": "truth"})
    assert by_truth.recording_key != experiment.recording_key


def test_what_cannot_steer_is_refused_before_anything_is_simulated():
    for overrides, message in (
        ([ONBOARD], "route.feedback needs a sensor laser, and sensors=encoder has none"),
        (["route.feedback={_target_: nowhere.Mine}"], "no module nowhere"),
        (["route.feedback={kr: 1}"], "must be truth, odometry or a mapping"),
        (["route=linear_1", "+route.feedback=odometry"], "unknown key route.feedback"),
    ):
        with pytest.raises(InputError, match=re.escape(message)):
            Experiment.compose(overrides).check()
