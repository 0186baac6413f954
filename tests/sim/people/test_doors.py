"""Doors that open and close: never before somebody, and rays end at what is shut."""

import numpy as np
import pytest

from sim.people.doors import Doors
from sim.people.walk import People
from sim.robot.drive import DifferentialDrive
from sim.routes.route import Tour
from sim.sensors import Laser, Mount
from sim.sensors.rays import AmongFaces, ExactRays
from sim.simulate import Member, record
from sim.worlds.buildings import Rooms
from sim.worlds.world import World

LEAF = np.array([[4.0, -0.5, 4.0, 0.5]])
NOBODY, SOMEBODY = np.zeros((0, 3)), np.array([[2.5, 0.0, 0.0]])
NONE = World("none", np.zeros((0, 4)), np.zeros((0, 2)))


def shares(others, seconds=200):
    doors, found = Doors(LEAF, others, np.random.default_rng(1)), []
    for tick in range(300 * seconds):
        doors.advance(tick, others)
        faces, _ = doors.faces()
        found.append(float(faces[0, 3] - faces[0, 1]) if len(faces) else 0.0)
    return np.array(found)


def test_doors_slide_now_and_then():
    shut = shares(NOBODY)
    assert 0.2 < np.mean(shut > 0.99) < 0.8
    assert 0.2 < np.mean(shut < 0.01) < 0.8
    assert np.abs(np.diff(shut)).max() <= 0.0201  # at most 2 % of its width a step of 20 ms


def test_a_door_is_open_where_somebody_stands():
    assert not shares(SOMEBODY, 60).any()


def test_rays_end_at_a_shut_door():
    doors = Doors(LEAF, NOBODY, np.random.default_rng(1))
    doors._open[:] = 0.0
    rays = AmongFaces(ExactRays(NONE), doors.faces)
    assert rays.scan(Laser(n_beams=1), np.zeros(3))[0] == pytest.approx(4.0)
    points = np.array([[6.0, 0.0, 1.0], [6.0, 0.0, 9.0]])
    assert rays.sees(np.array([0.0, 0.0, 1.0]), points).tolist() == [False, True]
    doors._open[:] = 1.0
    assert np.isinf(rays.scan(Laser(n_beams=1), np.zeros(3))[0])


def test_a_robot_drives_through_them_and_sees_them():
    def drive(**options):
        world = Rooms(n_x=2, n_y=2, n_landmarks=0, **options).build(np.random.default_rng(0))
        streams = {a: np.random.default_rng([0, i]) for i, a in enumerate(("slip", "sensors"))}
        robot = DifferentialDrive(wheel_radius_m=0.1, track_m=0.38)
        laser = Laser(n_beams=181, mount=Mount(z_m=0.25), sigma_range_m=0.0)
        member = Member(robot, {"laser": laser}, Tour(distance_m=20.0), streams)
        return record(
            world, member, physics="kinematic", rays="exact",
            passers_by=(People(), np.random.default_rng(3)),
        )  # fmt: skip

    with_doors, without = drive(doors_share=1.0), drive()
    assert with_doors.status == without.status == "ok"
    assert np.array_equal(with_doors.world.walls, without.world.walls)
    assert len(with_doors.world.doors) == 4
    shorter = with_doors.log("laser")["ranges_m"] < without.log("laser")["ranges_m"] - 0.05
    assert 0.005 < shorter.mean() < 0.2
    assert np.array_equal(with_doors.truth.poses, without.truth.poses)
