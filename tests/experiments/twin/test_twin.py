"""A twin of a recording whose faults are known finds them, and predicts its errors."""

import dataclasses

import numpy as np
import pytest
from typer.testing import CliRunner

from estimators.base import Prior
from estimators.odometry import Odometry
from experiments.cli.main import app
from experiments.evaluation.metrics import position_errors_m, rms
from experiments.runs.dependencies.digests import changed
from experiments.runs.dependencies.recorder import recorded
from experiments.runs.experiment import Experiment
from experiments.twin.make import make_twin, way_of
from sim import se2
from sim.errors import InputError
from sim.formats.tum import write_tum
from sim.recording import Truth, save
from sim.robot.base import TICK_S
from sim.robot.drive import DifferentialDrive
from sim.robot.kinematic import KinematicBody
from sim.routes.timetable import Drive, Timetable
from sim.sensors import Mount, RealCamera, RealLaser, View
from tests.estimators.landmarks.test_ekf_slam import follow
from tests.fixtures.fakes import square_room

DRIVE = (
    "world=room world.n_landmarks=60 robot=robocom robot.kr=3e-4 robot.kl=3e-4 "
    "robot.forward_slip_m=1e-3 simulation.physics=kinematic sensors=real_camera "
    "sensors.stereo.misread_share=0.01 sensors.stereo.detection_s=0.6 "
    "sensors.stereo.detection_share=0.4 sensors.stereo.max_distance_m=6.0 "
    "route.speed_mps=0.3 seed=5"
)


@pytest.fixture(scope="module")
def log():
    """Three minutes of a drive."""
    return Experiment.compose([*DRIVE.split(), "route.distance_m=50"]).simulate()


@pytest.fixture(scope="module")
def twin(log):
    return make_twin(log, split_s=120.0)


def error_m(recording):
    """ATE of dead reckoning from the true start."""
    start = recording.truth_at(recording.frame_stamps[:1])[0]
    prior = Prior(recording.robot, recording.sensors, start, np.zeros((3, 3)))
    online = follow(Odometry(kr=1e-4, kl=1e-4), recording, prior, keep=())
    return rms(position_errors_m(recording.truth_at(online.stamps), online.means))


def test_the_recording_is_whole(log):
    assert log.status == "ok"
    assert log.duration_s > 100.0


def test_what_was_planted_is_found(twin):
    camera = twin.sensors["stereo"]
    assert isinstance(camera, RealCamera)
    assert camera.sigma_depth == pytest.approx(0.0074, rel=0.2)
    assert camera.sigma_bearing_rad == pytest.approx(0.0126, rel=0.2)
    assert camera.lasting_share == pytest.approx(0.45, abs=0.15)
    assert 0.25 < camera.detection_share < 0.42  # furniture hides some of those in view
    assert 0.4 < camera.detection_s < 1.2
    assert 0.003 < camera.misread_share < 0.02
    assert camera.rate_hz == pytest.approx(300.0 / 70.0)
    assert 1.5e-4 < twin.robot.kr < 6e-4
    assert 4e-4 < twin.robot.forward_slip_m < 2.5e-3


@pytest.mark.slow
def test_a_twin_predicts_the_error_and_more_slip_is_out_of_its_reach(twin):
    predicted = [error_m(twin.simulate(seed)) for seed in range(12)]
    low, high = min(predicted), max(predicted)
    assert low < error_m(twin.rest) < high
    slippery = {k: 9.0 * getattr(twin.robot, k) for k in ("kr", "kl", "forward_slip_m")}
    worse = dataclasses.replace(twin, robot=dataclasses.replace(twin.robot, **slippery))
    others = np.array([error_m(worse.simulate(seed)) for seed in range(50, 56)])
    assert np.sum((others > low) & (others < high)) <= 2


def test_a_simulation_keeps_to_the_way(twin):
    made = twin.simulate(3)
    assert made.status == "ok"
    assert made.duration_s == pytest.approx(twin.stamps[-1], abs=0.1)
    off = position_errors_m(twin.way, made.truth_at(np.minimum(twin.stamps, made.duration_s)))
    assert off.max() < 0.1
    assert made.sensors == twin.sensors  # what is believed, not what was drawn


def test_files_are_a_study_that_runs(tmp_path, log, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save(log, tmp_path / "log.npz")
    ended = CliRunner().invoke(app, ["twin", "log.npz", "-o", "again.yaml"])
    assert ended.exit_code == 0, ended.output
    ours = make_twin(log)
    experiment = Experiment.compose(["study=again.yaml"])
    experiment.check()
    assert experiment.robot().kr == pytest.approx(ours.robot.kr, rel=1e-6)
    assert experiment.sensors()["stereo"].misread_share == pytest.approx(
        ours.sensors["stereo"].misread_share
    )
    assert np.allclose(experiment.world().landmarks, ours.landmarks)
    assert np.allclose(experiment.route().way[1], ours.way)
    beside = Experiment.compose(["study=again.yaml", "recording=again_log.npz"])
    assert beside.recording().checksum == ours.rest.checksum
    with recorded() as seen:
        assert experiment.route().way is not None
    found = seen.digests()
    write_tum(tmp_path / "again_way.tum", ours.stamps[:20], ours.way[:20])
    assert changed(found) == [str(tmp_path / "again_way.tum")]


def test_bad_input_is_named(tmp_path, log):
    for name in ("twin.txt", "my twin.yaml"):
        ended = CliRunner().invoke(app, ["twin", "log.npz", "-o", name])
        assert isinstance(ended.exception, InputError)
    with pytest.raises(InputError, match="a twin needs a laser or a camera"):
        make_twin(log.without("stereo"))
    with pytest.raises(InputError, match=r"must name a \.tum file"):
        Timetable(path=None).start(
            square_room(), DifferentialDrive(wheel_radius_m=0.05, track_m=0.2)
        )
    with pytest.raises(InputError, match="no such file"):
        Experiment.compose(["study=nowhere.yaml"])
    with pytest.raises(InputError, match="short_share"):
        RealLaser(short_share=1.5)
    with pytest.raises(InputError, match="stamps must be"):
        RealLaser(stamps=[1.0, 0.5])
    with pytest.raises(InputError, match="misread_share"):
        RealCamera(misread_share=-0.1)


def test_a_way_goes_through_the_known_poses(log):
    """Wheels that are 3 % too long, and a pose every 5 s: the way still meets each of them."""
    truth = log.known_truth
    sparse = np.arange(0, len(truth.stamps), 22)
    stamps, way = way_of(log, truth.stamps[sparse], truth.poses[sparse])
    found = way[np.searchsorted(stamps, truth.stamps[sparse])]
    assert np.allclose(se2.difference(found, truth.poses[sparse]), 0.0, atol=1e-9)
    between = np.interp(truth.stamps, stamps, way[:, 0]) - truth.poses[:, 0]
    assert np.abs(between[: sparse[-1]]).max() < 0.15


def test_a_follower_comes_back_to_its_way():
    stamps = np.arange(0.0, 20.0, 0.5)
    way = np.stack([0.3 * stamps, np.sin(0.3 * stamps), np.arctan(np.cos(0.3 * stamps))], axis=1)
    world, robot = square_room(), DifferentialDrive(wheel_radius_m=0.05, track_m=0.2)
    _, driver = Drive(stamps, way).start(world, robot)
    body = KinematicBody(robot, way[0] + [0.0, 0.2, 0.3])
    tick = 0
    while (wanted := driver.command(tick, body.pose)) is not None:
        body.step(*robot.wheel_speeds(*wanted))
        tick += 1
    assert tick * TICK_S == pytest.approx(stamps[-1], abs=0.03)
    assert np.hypot(*(body.pose - way[-1])[:2]) < 0.02
    assert driver.trouble is None
    driver.command(0, way[0] + [3.0, 0.0, 0.0])
    assert driver.trouble == "off_route"


def test_a_backward_way_is_followed_too():
    stamps = np.arange(0.0, 10.0, 0.5)
    way = np.stack([-0.3 * stamps, 0.0 * stamps, 0.0 * stamps], axis=1)
    robot = DifferentialDrive(wheel_radius_m=0.05, track_m=0.2)
    _, driver = Drive(stamps, way).start(square_room(), robot)
    body = KinematicBody(robot, [0.0, 0.1, 0.0])
    for tick in range(2000):
        body.step(*robot.wheel_speeds(*driver.command(tick, body.pose)))
    assert abs(body.pose[1]) < 0.02


class Walls:
    """Rays that all end at 5 m, but for the last ten."""

    def scan(self, scanner, pose):
        return np.append(np.full(scanner.n_beams - 10, 5.0), np.full(10, np.inf))


def test_a_real_laser_fails_as_often_as_it_says():
    laser = RealLaser(
        n_beams=400, sigma_range_m=0.0, short_share=0.1, short_beams=4.0,
        missing_share=0.05, missing_beams=3.0, stamps=[0.0, 0.25, 0.29, 1.0],
    )  # fmt: skip
    probe = laser.start(np.random.default_rng(0))
    view = View(0.0, np.zeros(3), square_room(), Walls(), 0.0, np.zeros(3))
    fired = [t for t in np.arange(0.0, 2.0, 0.1) if probe(dataclasses.replace(view, stamp=t))]
    assert fired == pytest.approx([0.0, 0.3, 1.0])
    probe = dataclasses.replace(laser, stamps=None).start(np.random.default_rng(1))
    scans = np.array([probe(view)["ranges_m"] for _ in range(400)])
    assert np.isinf(scans[:, -10:]).all()
    seen = scans[:, :-10]
    short = seen < 4.999
    assert short.mean() == pytest.approx(0.1, abs=0.006)
    assert np.isinf(seen).mean() == pytest.approx(0.9 * 0.05, abs=0.005)
    again = short[:, 1:][short[:, :-1]].mean()
    assert again == pytest.approx(0.1 + 0.9 * 0.75, abs=0.03)


def test_a_real_cameras_errors_have_their_spread_and_last():
    world = square_room(30)
    camera = RealCamera(
        rate_hz=4.0, sigma_depth=0.02, sigma_bearing_rad=0.01, lasting_share=0.6, lasting_s=1.0,
        detection_share=0.5, detection_s=0.5, fov_vertical_rad=2.5, scale=1.05,
        mount=Mount(x_m=0.0, y_m=0.0, z_m=0.5),
    )  # fmt: skip
    exact = RealCamera(fov_vertical_rad=2.5, mount=camera.mount)
    blank = View(0.0, np.zeros(3), world, Sees(), 0.0, np.zeros(3))

    def seen(sensor, n):
        probe = sensor.start(np.random.default_rng(0))
        probe.begin(blank)
        for i in range(n):
            yield probe(dataclasses.replace(blank, stamp=0.25 * i, last_stamp=0.25 * (i - 1)))

    (whole,) = seen(exact, 1)
    depths = dict(zip(whole["ids"], whole["points_in_camera"][:, 2], strict=True))
    errors = np.full((4000, len(world.landmarks)), np.nan)
    for row, reading in zip(errors, seen(camera, len(errors)), strict=True):
        if reading is not None:
            true = np.array([depths[i] for i in reading["ids"]])
            row[reading["ids"]] = reading["points_in_camera"][:, 2] / true - 1.05
    inside = errors[:, list(depths)]
    assert np.isfinite(inside).mean() == pytest.approx(0.5, abs=0.03)
    assert np.nanstd(inside) == pytest.approx(1.05 * 0.02, rel=0.05)
    alike = np.nanmean(inside[1:] * inside[:-1]) / np.nanvar(inside)
    assert alike == pytest.approx(0.6 * np.exp(-0.25), abs=0.05)


class Sees:
    """Rays that nothing hides."""

    def sees(self, origin, points):
        return np.ones(len(points), bool)


def test_forward_slip_moves_both_encoders_alike():
    drive = "world=empty sensors=encoder sensors.encoder.rate_hz=20 simulation.physics=kinematic"
    slip = "robot.kr=0 robot.kl=0 robot.forward_slip_m=1e-3 route=open_loop"
    route = "route.segments=[[0.5,0.0,150.0]]"
    made = Experiment.compose([*drive.split(), *slip.split(), route]).simulate()
    off = np.diff((made.wheels.position_m - made.truth.wheel_travel_m)[::20], axis=0)
    path = np.diff(made.truth.wheel_travel_m[::20], axis=0).mean(axis=1)
    assert np.allclose(off[:, 0], off[:, 1], atol=1e-12)
    assert np.mean(off[:, 0] ** 2) / np.mean(path) == pytest.approx(1e-3, rel=0.4)


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.slow
def test_forward_slip_that_lasts_has_the_variance_of_its_formula(seed):
    """The variance q (s - l (1 - exp(-s / l))) of the error over s, and white slip's is far off."""
    drive = "world=empty sensors=encoder sensors.encoder.rate_hz=20 simulation.physics=kinematic"
    slip = "robot.kr=0 robot.kl=0 robot.forward_slip_m=1e-3 robot.forward_slip_length_m=0.5"
    route = f"route=open_loop route.segments=[[0.5,0.0,1500.0]] seed={seed}"
    made = Experiment.compose([*drive.split(), *slip.split(), *route.split()]).simulate()
    error = made.wheels.position_m[:, 0] - made.truth.wheel_travel_m[:, 0]
    for steps in (4, 20, 80):
        path = 0.025 * steps
        law = 1e-3 * (path - 0.5 * (1.0 - np.exp(-path / 0.5)))
        found = np.mean((error[steps:] - error[:-steps]) ** 2)
        assert found == pytest.approx(law, rel=0.25)
        assert found < 0.9 * 1e-3 * path
    with pytest.raises(InputError, match=r"set robot\.forward_slip_m"):
        DifferentialDrive(wheel_radius_m=0.05, track_m=0.2, forward_slip_length_m=0.1)


def test_the_walls_of_a_laser_log_are_driven_through_nowhere(tmp_path):
    """A twin of scans in a room: the error of its dead reckoning is as large as the log's."""
    drive = (
        "world=room sensors=real_laser robot=robocom simulation.physics=kinematic seed=2 "
        "robot.kr=1e-4 robot.kl=1e-4 sensors.laser.short_share=0.05 route.distance_m=45"
    )
    log = Experiment.compose(drive.split()).simulate()
    truth = log.known_truth
    every = np.arange(0, len(truth.stamps), 1)
    log = dataclasses.replace(log, truth=Truth(truth.stamps[every], truth.poses[every]))
    twin = make_twin(log)
    laser = twin.sensors["laser"]
    assert laser.short_share == pytest.approx(0.05, abs=0.03)
    assert laser.missing_share == pytest.approx(0.041, abs=0.02)
    assert laser.sigma_range_m == pytest.approx(0.0104, rel=0.5)
    made = twin.simulate(0)
    assert made.status == "ok"
    assert len(made.log("laser").stamps) == pytest.approx(len(laser.stamps), abs=1)
