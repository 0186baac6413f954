"""Recordings: the engine's robot against geometry and against the kinematic one."""

import dataclasses

import numpy as np
import pytest

from experiments.runs.experiment import Experiment
from experiments.runs.seeds import stream
from sim import se2
from sim.errors import InputError
from sim.robot.arc import arc_increment
from sim.robot.collisions import overlaps
from sim.robot.drive import DifferentialDrive
from sim.routes.route import OpenLoop, Tour
from sim.sensors import Encoder, Laser, Lidar3D, Mount, StereoCamera
from sim.sensors.stereo import points_in_camera
from sim.simulate import Member, record
from sim.worlds.world import World
from tests.fixtures.fakes import true_ids

EMPTY = World("open", np.zeros((0, 4)), np.zeros((0, 2)))
PUZZLEBOT = DifferentialDrive(wheel_radius_m=0.05, track_m=0.19)
ROBOCOM = DifferentialDrive(
    wheel_radius_m=0.10,
    track_m=0.44,
    body_length_m=0.48,
    body_width_m=0.36,
    body_height_m=0.3,
    mass_kg=15.0,
)


def streams(seed=0):
    return {axis: stream(seed, axis) for axis in ("slip", "sensors")}


def drive(robot, *segments, sensors=None, physics="bullet", seed=0, world=EMPTY, **options):
    sensors = sensors or {"encoder": Encoder()}
    rays = "bullet" if physics == "bullet" else "exact"
    options = {"rays": rays, **options}
    return record(
        world,
        Member(robot, sensors, OpenLoop(segments=segments), streams(seed)),
        physics=physics,
        **options,
    )


@pytest.mark.bullet
@pytest.mark.parametrize("robot", [PUZZLEBOT, ROBOCOM], ids=["puzzlebot", "robocom"])
def test_without_slip_two_metres_are_straight(robot):
    poses = drive(robot, (0.5, 0.0, 4.0)).truth.poses
    moved = se2.between(poses[0], poses[-1])
    assert np.hypot(moved[0] - 2.0, moved[1]) < 1e-4
    assert abs(np.degrees(moved[2])) < 0.01


@pytest.mark.bullet
@pytest.mark.parametrize("robot", [PUZZLEBOT, ROBOCOM], ids=["puzzlebot", "robocom"])
def test_without_slip_the_track_is_the_nominal_one(robot):
    for command in ((0.0, 0.5, 6.0), (0.3, 0.4, 6.0)):
        truth = drive(robot, command).truth
        turn = np.unwrap(truth.poses[:, 2])
        rolled = truth.wheel_travel_m[-1] - truth.wheel_travel_m[0]
        track = (rolled[0] - rolled[1]) / (turn[-1] - turn[0])
        assert track == pytest.approx(robot.track_m, rel=1e-4)


@pytest.mark.bullet
@pytest.mark.parametrize("k", [1e-5, 1e-4, 1e-3])
def test_slip_law_of_the_engine(k):
    """k within 5 %, wheels uncorrelated and white, for kr != kl."""
    robot = dataclasses.replace(PUZZLEBOT, kr=k, kl=2 * k)
    recording = drive(robot, (0.5, 0.3, 50.0), sensors={"encoder": Encoder(rate_hz=100.0)}, seed=1)
    ground = np.diff(recording.truth.wheel_travel_m, axis=0)
    error = np.diff(recording.wheels.position_m, axis=0) - ground
    found = np.sum(error**2, axis=0) / np.sum(np.abs(ground), axis=0)
    assert found / [k, 2 * k] == pytest.approx([1.0, 1.0], abs=0.05)
    assert abs(np.corrcoef(error.T)[0, 1]) < 0.03
    for i in (0, 1):
        assert abs(np.corrcoef(error[1:, i], error[:-1, i])[0, 1]) < 0.03


@pytest.mark.bullet
def test_engine_and_kinematic_robot_agree_run_by_run():
    """With the same stream of noise the two bodies end in the same place."""
    robot = dataclasses.replace(PUZZLEBOT, kr=1e-4, kl=5e-5)
    for seed in range(3):
        ends = [
            drive(robot, (0.5, 0.4, 6.0), physics=physics, seed=seed).truth.poses[-1]
            for physics in ("bullet", "kinematic")
        ]
        assert np.hypot(*(ends[0] - ends[1])[:2]) < 2e-3
        assert abs(se2.wrap(ends[0][2] - ends[1][2])) < 2e-3


@pytest.mark.bullet
def test_wheel_travel_integrates_to_the_true_pose():
    robot = dataclasses.replace(PUZZLEBOT, kr=1e-4, kl=1e-4)
    truth = drive(robot, (0.4, 0.5, 8.0), sensors={"encoder": Encoder(rate_hz=100.0)}).truth
    pose = truth.poses[0]
    for increment in np.diff(truth.wheel_travel_m, axis=0):
        pose = se2.compose(pose, arc_increment(increment, robot.track_m))
    assert np.hypot(*(pose - truth.poses[-1])[:2]) < 2e-3


def test_quantised_counts_are_whole_and_do_not_drift():
    tick = 0.002
    robot = dataclasses.replace(PUZZLEBOT, encoder_tick_m=tick)
    recording = drive(robot, (0.3, 0.0, 5.0), physics="kinematic")
    counts = recording.wheels.position_m / tick
    assert np.allclose(counts, np.round(counts))
    error = recording.wheels.position_m - recording.truth.wheel_travel_m
    assert np.all(np.abs(error) <= tick)


def test_unmodelled_slip_is_off_unless_asked_for_and_adds_up_when_it_is():
    calm = drive(PUZZLEBOT, (0.5, 0.0, 20.0), physics="kinematic")
    assert np.allclose(calm.wheels.position_m, calm.truth.wheel_travel_m, atol=1e-12)
    rough = dataclasses.replace(PUZZLEBOT, unmodelled_slip=1.0, unmodelled_slip_m=0.02)
    recording = drive(rough, (0.5, 0.0, 20.0), physics="kinematic")
    lost = (recording.wheels.position_m - recording.truth.wheel_travel_m)[-1]
    assert np.all((lost > 0.1) & (lost < 0.8))


def test_frames_come_from_every_sensor_at_its_own_rate():
    world = Experiment.compose(["world=room", "seed=0"]).world()
    sensors = {
        "encoder": Encoder(rate_hz=20.0),
        "laser": Laser(rate_hz=15.0, n_beams=31),
        "stereo": StereoCamera(rate_hz=5.0),
        "lidar3d": Lidar3D(rate_hz=1.0),
    }
    recording = drive(PUZZLEBOT, (0.2, 0.0, 2.0), sensors=sensors, physics="kinematic", world=world)
    end = recording.frame_stamps[-1]
    for name, rate in (("laser", 15), ("stereo", 5), ("lidar3d", 1)):
        log = recording.log(name)
        assert len(log.stamps) == int(end * rate + 1e-9) + 1
        assert np.isin(log.stamps, recording.frame_stamps).all()
    frames = list(recording.frames())
    assert sum("laser" in f.readings for f in frames) == len(recording.log("laser").stamps)
    assert np.all(np.diff(recording.frame_stamps) > 0)


def test_stereo_sees_what_geometry_says():
    """Every observation is near its landmark; nothing behind a wall, out of view or too far."""
    world = Experiment.compose(["world=gil2008", "seed=3"]).world()
    camera = StereoCamera(
        rate_hz=2.0, max_distance_m=6.0, sigma_column_px=0, sigma_row_px=0, sigma_disparity_px=0
    )
    recording = record(
        world,
        Member(ROBOCOM, {"stereo": camera}, Tour(distance_m=15.0), streams()),
        physics="kinematic",
        rays="exact",
    )
    log, seen = recording.log("stereo"), world.landmarks[true_ids(recording)]
    assert len(log["points_in_camera"]) > 100
    for row, stamp in enumerate(log.stamps):
        rows = slice(*log.splits[row : row + 2])
        pose = recording.truth_at(np.array([stamp]))[0]
        expected = points_in_camera(camera, pose, seen[rows])
        assert np.allclose(log["points_in_camera"][rows], expected, atol=1e-9)
        assert np.all(np.linalg.norm(expected, axis=1) <= 6.0)
        x, y, z = expected.T
        assert np.all(np.abs(x) <= z * np.tan(np.radians(40)) + 1e-9)
        assert np.all(np.abs(y) <= z * np.tan(np.radians(30)) + 1e-9)


@pytest.mark.parametrize("selection", ["nearest", "random", "spread"])
def test_selection_keeps_b_of_them(selection):
    world = Experiment.compose(["world=gil2008", "seed=3", "world.n_landmarks=800"]).world()
    exact = {"sigma_column_px": 0.0, "sigma_row_px": 0.0, "sigma_disparity_px": 0.0}
    camera = StereoCamera(rate_hz=1.0, max_observations=5, selection=selection, **exact)
    sensors = {"encoder": Encoder(), "stereo": camera}

    def tour(sensors):
        route = Tour(distance_m=8.0)
        return record(
            world, Member(ROBOCOM, sensors, route, streams()), physics="kinematic", rays="exact"
        )

    recording = tour(sensors)
    counts = np.diff(recording.log("stereo").splits)
    assert counts.max() == 5
    if selection == "nearest":
        every = dataclasses.replace(camera, max_observations=0)
        whole = tour({**sensors, "stereo": every})
        log, kept = whole.log("stereo"), true_ids(recording)
        for i in range(len(log.stamps)):
            rows = slice(*log.splits[i : i + 2])
            distance = np.linalg.norm(log["points_in_camera"][rows], axis=1)
            nearest = true_ids(whole)[rows][np.argsort(distance)[:5]]
            mine = kept[slice(*recording.log("stereo").splits[i : i + 2])]
            assert set(mine) == set(nearest)


@pytest.mark.bullet
def test_the_robot_is_not_in_its_own_scan():
    world = Experiment.compose(["world=room", "seed=0"]).world()
    laser = Laser(n_beams=90, fov_rad=2 * np.pi, sigma_range_m=0.0, mount=Mount(z_m=0.05))
    recording = drive(
        PUZZLEBOT, (0.1, 0, 1.0), sensors={"encoder": Encoder(), "laser": laser}, world=world
    )
    assert recording.log("laser")["ranges_m"].min() > 0.3


@pytest.mark.bullet
def test_a_collision_is_reported_where_it_happens():
    wall = World("wall", np.array([[1.0, -1, 1.0, 1]]), np.array([[0.0, 1.0]]))
    for physics in ("bullet", "kinematic"):
        recording = drive(PUZZLEBOT, (0.5, 0.0, 6.0), physics=physics, world=wall)
        assert recording.status.startswith("collision at "), physics
        assert recording.truth.poses[-1, 0] == pytest.approx(1.0 - 0.09, abs=0.02)
        assert recording.frame_stamps[-1] < 3.0


def test_leaving_the_route_is_reported():
    rough = dataclasses.replace(PUZZLEBOT, max_acceleration_mps2=0.02)
    recording = record(
        EMPTY,
        Member(
            rough,
            {"encoder": Encoder()},
            Tour(speed_mps=1.0, waypoints=((0, 0), (6, 0), (6, 6)), tolerance_m=0.05),
            streams(),
        ),
        physics="kinematic",
        rays="exact",
    )
    assert recording.status.startswith("off_route at ")


@pytest.mark.bullet
@pytest.mark.parametrize(
    "name", ["room", *(pytest.param(n, marks=pytest.mark.slow) for n in ("rooms", "corridor"))]
)
@pytest.mark.parametrize("robot", ["puzzlebot", "robocom"])
def test_tours_are_driven_to_their_end(name, robot):
    experiment = Experiment.compose([f"world={name}", f"robot={robot}", "seed=2", "robot.kr=1e-4"])
    recording = experiment.simulate()
    assert recording.status == "ok"
    world = experiment.world()
    assert np.hypot(*(recording.truth.poses[-1, :2] - world.waypoints[-1])) < 0.15


def test_a_longer_distance_goes_round_again():
    tour = Tour(waypoints=((0, 0), (2, 0), (2, 2), (0, 2), (0, 0)), distance_m=19.0)
    recording = record(
        EMPTY,
        Member(PUZZLEBOT, {"encoder": Encoder()}, tour, streams()),
        physics="kinematic",
        rays="exact",
    )
    assert recording.status == "ok"
    assert np.sum(np.hypot(*np.diff(recording.truth.poses[:, :2], axis=0).T)) > 17.5
    assert np.hypot(*(recording.truth.poses[-1, :2] - [2, 1])) < 0.15


def test_footprint_overlap():
    wall = World("wall", np.array([[1.0, -1, 1.0, 1]]), np.array([[0.0, 1.0]]))
    assert overlaps(wall, PUZZLEBOT, np.array([0.95, 0.0, 0.3]))
    assert not overlaps(wall, PUZZLEBOT, np.array([0.7, 0.0, 0.3]))
    inside = World("post", np.array([[0.0, 0, 0.01, 0]]), np.array([[0.0, 1.0]]))
    assert overlaps(inside, PUZZLEBOT, np.zeros(3))
    lintel = World("lintel", np.array([[0.0, -1, 0, 1]]), np.array([[2.0, 2.5]]))
    assert not overlaps(lintel, PUZZLEBOT, np.zeros(3))
    with pytest.raises(InputError, match="overlaps a wall of world post"):
        drive(PUZZLEBOT, (0.1, 0, 1), physics="kinematic", world=inside)


def test_rates_must_divide_the_clock():
    with pytest.raises(InputError, match=r"sensors\.encoder\.rate_hz=7 does not divide"):
        drive(
            PUZZLEBOT, (0.1, 0, 1), physics="kinematic", sensors={"encoder": Encoder(rate_hz=7.0)}
        )
    with pytest.raises(InputError, match="no sensor fires"):
        drive(
            PUZZLEBOT, (0.1, 0, 1), physics="kinematic", sensors={"encoder": Encoder(rate_hz=None)}
        )


@pytest.mark.slow
@pytest.mark.bullet
@pytest.mark.parametrize(
    ("name", "robot", "seed"),
    [("office", "robocom", 1000), ("office", "puzzlebot", 1), ("gil2008", "gil2008", 1001)],
)
def test_long_tours_are_driven_to_their_end(name, robot, seed):
    """Whole tours with slip, through doors and past furniture, at the studies' sizes."""
    experiment = Experiment.compose([f"world={name}", f"robot={robot}", f"seed={seed}"])
    recording = experiment.simulate()
    assert recording.status == "ok"
    travelled = np.sum(np.hypot(*np.diff(recording.truth.poses[:, :2], axis=0).T))
    assert travelled > (300 if name == "office" else 140)


@pytest.mark.slow
@pytest.mark.parametrize("world_seed", range(1000, 1020, 4))
def test_offices_can_be_toured(world_seed):
    """The judged studies' buildings: no tour ends in a wall, for the larger robot."""
    experiment = Experiment.compose(
        [
            "world=office",
            "robot=robocom",
            f"seed={world_seed}",
            "simulation.physics=kinematic",
            "simulation.rays=exact",
            "sensors.encoder.rate_hz=5",
        ]
    )
    assert experiment.simulate().status == "ok"
