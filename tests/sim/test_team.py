"""Teams: robots that see one another, what hides them, files, and MRCLAM."""

import dataclasses
import json

import numpy as np
import pytest

from experiments.runs.seeds import stream
from sim import recording as recordings
from sim import team as teams
from sim.errors import InputError
from sim.formats import mrclam
from sim.npz import read_arrays
from sim.robot.drive import DifferentialDrive
from sim.routes.route import OpenLoop
from sim.sensors import Laser, Mount, RobotCamera, StereoCamera
from sim.sensors.stereo import points_in_camera
from sim.simulate import Member, record, record_team
from sim.team import Team
from sim.worlds.world import World
from tests.fixtures import log_samples as samples
from tests.fixtures.fakes import circle

ROBOT = DifferentialDrive(
    wheel_radius_m=0.1, track_m=0.4, body_length_m=0.4, body_width_m=0.3, body_height_m=0.3
)
STILL = ((0.0, 0.0, 2.0),)
TURNING = ((0.0, 0.5, 4.0),)
EYES = {"robots": RobotCamera(rate_hz=10.0)}


@dataclasses.dataclass(frozen=True)
class From:
    """A route from a pose of its own."""

    pose: tuple
    segments: tuple = STILL

    def start(self, world, robot):
        _, driver = OpenLoop(segments=self.segments).start(world, robot)
        return np.array(self.pose, float), driver


def world_of(*walls, landmarks=()):
    return World(
        "open",
        np.array(walls, float).reshape(-1, 4),
        np.tile([0.0, 2.5], (len(walls), 1)),
        landmarks=np.array(landmarks, float).reshape(-1, 3),
    )


def team_of(*routes, world=None, sensors=EYES, robot=ROBOT, seed=0):
    streams = [
        {axis: stream(seed, axis, k) for axis in ("slip", "sensors")} for k in range(len(routes))
    ]
    members = [Member(robot, sensors, *each) for each in zip(routes, streams, strict=True)]
    world = world or world_of()
    return record_team(world, members, physics="kinematic", rays="exact")


def seen_by(team, number):
    return {int(i) for i in team.robots[number].logs["robots"]["ids"]}


def test_a_team_of_one_is_the_robot_alone():
    robot = dataclasses.replace(ROBOT, kr=1e-4, kl=1e-4)
    world = world_of([3, -3, 3, 3], landmarks=[[2.9, 0.5, 0.4]])
    sensors = {"laser": Laser(rate_hz=10.0), "stereo": StereoCamera(), **EYES}
    team = team_of(From((0, 0, 0), TURNING), world=world, sensors=sensors, robot=robot)
    streams = {axis: stream(0, axis) for axis in ("slip", "sensors")}
    route = From((0, 0, 0), TURNING)
    alone = record(world, Member(robot, sensors, route, streams), physics="kinematic", rays="exact")
    assert alone.checksum == team.robots[0].checksum
    assert len(alone.logs["robots"]["ids"]) == 0


def test_robots_see_those_before_them_within_reach():
    team = team_of(From((0, 0, 0)), From((4, 0, np.pi)), From((-4, 0, np.pi)), From((15, 0, 0)))
    assert [seen_by(team, k) for k in range(4)] == [{1}, {0, 2}, set(), set()]


def test_walls_hide_robots_and_bodies_hide_what_is_low():
    wall = world_of([2, -1, 2, 1])
    assert seen_by(team_of(From((0, 0, 0)), From((4, 0, 0)), world=wall), 0) == set()
    low = {"robots": RobotCamera(rate_hz=10.0, marker_z_m=0.35, mount=Mount(z_m=0.2))}
    row = [From((0, 0, 0)), From((3, 0, 0)), From((6, 0, 0))]
    assert seen_by(team_of(*row, sensors=low), 0) == {1}  # at 3 m the sight line is below its top
    assert seen_by(team_of(*row), 0) == {1, 2}
    hidden = {"robots": RobotCamera(rate_hz=10.0, marker_z_m=0.25)}
    assert seen_by(team_of(*row, sensors=hidden), 0) == set()  # by its own body
    behind = world_of(landmarks=[[6, 0, 0.1], [6, 1.5, 0.1]])
    eye = {"stereo": StereoCamera(rate_hz=10.0, mount=Mount(z_m=0.2))}
    both = team_of(From((0, 0, 0)), From((3, 0, 0)), world=behind, sensors=eye)
    assert set(both.robots[0].logs["stereo"]["ids"]) == {1}


def test_a_laser_ranges_the_body_of_another_robot():
    laser = Laser(rate_hz=10.0, n_beams=3, fov_rad=0.2, sigma_range_m=0.0, mount=Mount(z_m=0.2))
    team = team_of(From((0, 0, 0)), From((3, 0, 0)), sensors={"laser": laser})
    ahead = team.robots[0].logs["laser"]["ranges_m"][:, 1]
    np.testing.assert_allclose(ahead, 3.0 - ROBOT.body_length_m / 2, atol=1e-5)


def test_a_robot_that_has_arrived_stands_and_is_seen():
    team = team_of(From((0, 0, 0), TURNING), From((1, 3, 0), ((0.0, 0.0, 0.5),)))
    first, second = (robot.frame_stamps[-1] for robot in team.robots)
    assert second < first
    log = team.robots[0].logs["robots"]
    assert log.stamps[np.diff(log.splits) > 0].max() > second + 1.0
    counts = [len(frames) for frames in team.instants()]
    assert set(counts) == {1, 2}
    assert sum(counts) == sum(len(robot.frame_stamps) for robot in team.robots)


def test_noise_of_sightings_is_that_of_the_pixels():
    eyes = {"robots": RobotCamera(rate_hz=300.0)}
    still = [From(pose, ((0.0, 0.0, 10.0),)) for pose in ((0, 0, 0), (4, 1, 0))]
    team, camera = team_of(*still, sensors=eyes), eyes["robots"].camera
    points = team.robots[0].logs["robots"]["points_in_camera"]
    true = points_in_camera(camera, np.zeros(3), np.array([[4.0, 1.0, 0.5]]))[0]
    disparity = camera.focal_px * camera.baseline_m / points[:, 2]
    pixels = np.stack([camera.focal_px * points[:, i] / points[:, 2] for i in (0, 1)], axis=1)
    wanted = np.append(camera.focal_px * true[:2], camera.focal_px * camera.baseline_m) / true[2]
    off = np.column_stack([pixels, disparity]) - wanted
    assert len(off) > 2500
    np.testing.assert_allclose(off.std(axis=0), [1.0, 1.0, 0.5], rtol=0.05)
    assert (np.abs(off.mean(axis=0)) < 0.08).all()


def test_files_of_teams(tmp_path):
    team = team_of(From((0, 0, 0), TURNING), From((4, 0, np.pi)))
    path = tmp_path / "team.npz"
    teams.save(team, path)
    again = teams.load(path)
    assert [r.checksum for r in again.robots] == [r.checksum for r in team.robots]
    with pytest.raises(InputError, match=r"team.npz: it holds a team; run all"):
        recordings.load(path)
    recordings.save(team.robots[0], path)
    alone = teams.load(path)
    assert alone.only.checksum == alone.checksum == team.robots[0].checksum
    with pytest.raises(InputError, match="it holds a team; run all of its robots by study=teams"):
        assert again.only


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda arrays, meta: meta.update(team=meta["team"][:1]), "belong to none of its robots"),
        (lambda arrays, meta: meta.update(team=[3, 4]), "not"),
        (lambda arrays, meta: arrays.pop("1.frame_stamps"), "frame_stamps is missing"),
        (lambda arrays, meta: arrays.update({"1.frame_stamps": np.zeros(0)}), "is empty"),
        (lambda arrays, meta: arrays.update({"1.world.walls": np.ones((0, 4))}), "world"),
    ],
)
def test_hostile_files_of_teams(tmp_path, change, complaint):
    team, path = team_of(From((0, 0, 0)), From((4, 0, 0)), world=world_of([9, 0, 9, 1])), "t.npz"
    teams.save(team, tmp_path / path)
    arrays = read_arrays(tmp_path / path)
    meta = json.loads(arrays.pop("meta").tobytes())
    meta.pop("checksum")
    change(arrays, meta)
    recordings.write_arrays(tmp_path / path, arrays, meta)
    with pytest.raises(InputError, match=complaint):
        teams.load(tmp_path / path)


def test_a_team_has_one_clock_and_one_world():
    first, second = circle(n_frames=20), circle(n_frames=15)
    shifted = dataclasses.replace(second, frame_stamps=second.frame_stamps[:-1] + 0.03)
    with pytest.raises(InputError, match="Frames of robot 0 are not at the stamps of the others"):
        Team((first, shifted))
    team = Team.on_one_clock([first, shifted])
    stamps = np.union1d(first.frame_stamps, shifted.frame_stamps)
    assert np.array_equal(team.robots[0].frame_stamps, stamps[stamps <= first.frame_stamps[-1]])
    travelled = [sum(f.wheel_increments_m for f in r.frames()) for r in (first, team.robots[0])]
    np.testing.assert_allclose(*travelled, atol=1e-12)
    elsewhere = dataclasses.replace(first.truth, world=world_of([1, 2, 3, 4]))
    with pytest.raises(InputError, match="the world of robot 1 is not that of robot 0"):
        Team((first, dataclasses.replace(first, truth=elsewhere)))


def test_mrclam_as_a_team(tmp_path):
    members = samples.mrclam_members()
    for kind in ("Odometry", "Measurement", "Groundtruth"):
        members[f"Robot2_{kind}.dat"] = members[f"Robot1_{kind}.dat"]
    members["Robot1_Measurement.dat"] = b"0.2 72 2.0 0.1\n0.2 14 1.0 0.2\n0.6 25 3.0 -0.2\n"
    for name, data in members.items():
        (tmp_path / name).write_bytes(data)
    team = mrclam.read_team(tmp_path)
    log = team.robots[0].logs["robots"]
    assert (log.stamps.tolist(), log["ids"].tolist()) == ([0.2], [1])
    x, _, z = log["points_in_camera"][0]
    assert (z, np.arctan2(-x, z)) == pytest.approx((1.0, 0.2))
    assert team.robots[1].logs["robots"]["ids"].tolist() == [0]
    alone = mrclam.read_mrclam(tmp_path, 1)
    assert np.array_equal(alone.logs["stereo"]["ids"], team.robots[0].logs["stereo"]["ids"])
    assert team.robots[0].config["notes"]["sightings_of_robots"] == 1
