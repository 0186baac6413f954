"""People who walk about: where they may be, that nobody collides, what sensors see of them."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest

from sim.errors import InputError
from sim.people.walk import Crowd, People
from sim.recording import arrays_of, load, save
from sim.robot.drive import DifferentialDrive
from sim.routes.route import Tour
from sim.sensors import Laser, Lidar3D, Mount, StereoCamera
from sim.sensors.rays import AmongPeople, ExactRays, strike_discs
from sim.simulate import Member, record
from sim.worlds.buildings import Rooms, empty
from sim.worlds.world import World

ROBOT = DifferentialDrive(track_m=0.3, wheel_radius_m=0.05, body_length_m=0.4, body_width_m=0.3)
ROOMS = Rooms(n_x=2, n_y=1, n_landmarks=20)
LASER = Laser(n_beams=90, fov_rad=2.0 * np.pi, mount=Mount(z_m=0.25))
SENSORS = {"laser": LASER, "stereo": StereoCamera()}


def drive(n, seed=0, *, physics="kinematic", rays="exact", metres=6.0, **people):
    streams = {a: np.random.default_rng([seed, i]) for i, a in enumerate(("slip", "sensors"))}
    world = ROOMS.build(np.random.default_rng(seed))
    return record(
        world,
        Member(ROBOT, SENSORS, Tour(distance_m=metres), streams),
        physics=physics,
        rays=rays,
        passers_by=(People(n=n, **people), np.random.default_rng([seed, 9])),
    )


@pytest.fixture(scope="module")
def crowded():
    return drive(6, metres=12.0)


def test_nobody_walks_into_walls_or_the_robot(crowded):
    assert crowded.status == "ok"
    truth, radius = crowded.truth, People().radius_m
    assert truth.people.shape == (len(truth.stamps), 6, 3)
    reach = np.hypot(0.2, 0.15)
    away = np.hypot(*(truth.people[..., :2] - truth.poses[:, None, :2]).transpose(2, 0, 1))
    assert away.min() > reach + radius
    spots = truth.people[::5, :, :2].reshape(-1, 2)
    assert min(map(crowded.world.clearance_m, spots)) > radius


def test_people_walk_at_their_speeds(crowded):
    steps = np.diff(crowded.truth.people[..., :2], axis=0)
    speeds = np.hypot(*steps.transpose(2, 0, 1)) / np.diff(crowded.truth.stamps)[:, None]
    assert speeds.max() <= People().max_speed_mps + 1e-6
    assert np.all(np.median(speeds, axis=0) > 0.4)


def test_tracks_are_truth_alone_and_survive_a_file(crowded, tmp_path):
    assert all("people" not in vars(frame) for frame in crowded.frames())
    save(crowded, tmp_path / "crowd.npz")
    read = load(tmp_path / "crowd.npz")
    assert np.array_equal(read.truth.people, crowded.truth.people)
    assert "truth.people" not in arrays_of(drive(0))


def test_without_people_nothing_changes():
    streams = {a: np.random.default_rng([0, i]) for i, a in enumerate(("slip", "sensors"))}
    member = Member(ROBOT, SENSORS, Tour(distance_m=6.0), streams)
    alone = record(ROOMS.build(np.random.default_rng(0)), member, physics="kinematic", rays="exact")
    with_none = drive(0)
    assert alone.checksum == with_none.checksum
    assert drive(2, seed=1).checksum == drive(2, seed=1).checksum


def test_the_laser_sees_them():
    assert not np.array_equal(drive(4).log("laser")["ranges_m"], drive(0).log("laser")["ranges_m"])


@pytest.mark.bullet
def test_both_rays_and_bodies_know_them():
    exact = drive(4, physics="bullet", metres=3.0)
    engine = drive(4, physics="bullet", rays="bullet", metres=3.0)
    assert exact.status == engine.status == "ok"
    assert np.array_equal(exact.truth.people, engine.truth.people)
    ranges = [r.log("laser")["ranges_m"] for r in (exact, engine)]
    assert np.mean(np.abs(ranges[0] - ranges[1]) < 0.01) > 0.99


def crowd_at(states):
    """A crowd in an empty world that stands in given states (n, 4)."""
    world = empty(rng=np.random.default_rng(0))
    people = People(n=len(states))
    crowd = Crowd(people, world, [ROBOT], [np.zeros(3)], np.random.default_rng(0))
    crowd._states = [np.array(states, float)]
    return crowd, AmongPeople(ExactRays(world), crowd)


def test_rays_end_at_legs_below_and_at_the_torso_above():
    people = People()
    stance = 0.125 * people.stride_m  # both legs side by side: a quarter of the swing from its end
    crowd, rays = crowd_at([[3.0, 0.0, 0.0, 2.0 * stance]])
    legs = crowd.discs(np.array(0.0), 0.25)
    assert np.allclose(legs[:, 0], 3.0)
    assert np.allclose(sorted(legs[:, 1]), [-0.09, 0.09])
    low = Laser(n_beams=1, mount=Mount(z_m=0.25))
    high = Laser(n_beams=1, mount=Mount(z_m=1.2))
    over = Laser(n_beams=1, mount=Mount(z_m=1.8))
    at_leg = np.array([0.0, 0.09, 0.0])
    assert rays.scan(low, at_leg)[0] == pytest.approx(3.0 - people.leg_radius_m)
    assert np.isinf(rays.scan(low, np.zeros(3))[0])  # between the legs
    assert rays.scan(high, np.zeros(3))[0] == pytest.approx(3.0 - people.torso_radius_m)
    assert np.isinf(rays.scan(over, np.zeros(3))[0])


def test_a_foot_on_the_ground_stays_there():
    people = People()
    crowd, _ = crowd_at([[0.0, 0.0, 0.0, 0.0]])
    walked = np.linspace(0.0, people.stride_m, 41)
    states = np.column_stack([walked, 0 * walked, 0 * walked, walked])[:, None]
    feet = crowd.legs(states)[..., 0]  # (41, 2)
    steps = np.diff(feet, axis=0) / np.diff(walked)[:, None]
    assert np.allclose(np.sort(steps, axis=1), [0.0, 2.0])


def test_cameras_and_lidars_look_past_and_over():
    _, rays = crowd_at([[3.0, 0.0, 0.0, 0.0]])
    eye = np.array([0.0, 0.0, 1.0])
    points = np.array([[6.0, 0.0, 1.0], [6.0, 2.0, 1.0], [6.0, 0.0, 4.0], [2.0, 0.0, 1.0]])
    assert rays.sees(eye, points).tolist() == [False, True, True, True]
    lidar = Lidar3D(n_rings=3, n_azimuths=4, elevation_min_rad=-0.01, elevation_max_rad=0.5)
    cloud = rays.cloud(lidar, np.zeros(3))
    assert cloud[1, 2] == np.inf  # over the head, since the lidar stands at 1.5 m
    assert cloud[0, 2] == pytest.approx(2.8 / np.cos(0.01))


def driven_at(person, seconds):
    """A robot that wants to go on along x, with one person (x, y) who stays, and is not touched.

    Its driver, its pose, which the driver sees, positions (T,) m along x, and the last speed, m/s.
    """
    from sim.people.giving_way import GivingWay

    pose, reached = np.zeros(3), []
    command = SimpleNamespace(command=lambda tick, pose: np.array([0.5, 0.0]), trouble=None)
    crowd, _ = crowd_at([[*person, 0.0, 0.0]])
    driver = GivingWay(command, crowd, 0, ROBOT, lambda: pose)
    for tick in range(300 * seconds):
        velocity = driver.command(tick, pose)
        pose[0] += velocity[0] / 300.0
        reached.append(pose[0])
        assert driver.trouble is None
    return driver, pose, np.array(reached), velocity[0]


def test_the_robot_waits_for_somebody_who_stays():
    driver, pose, reached, speed = driven_at([2.0, 0.0], 25)
    gaps = 2.0 - reached - np.hypot(0.2, 0.15) - People().radius_m
    assert 0.2 < gaps[300 * 10] < 0.35  # with room to step aside
    assert 0.02 < gaps[-1] < 0.1  # once that has not helped
    assert abs(speed) < 0.01
    pose[:] = [2.0, 0.1, 0.0]
    assert driver.trouble == "collision"


@pytest.mark.parametrize("x_m", [-0.05, 0.0, 0.01])
def test_somebody_close_beside_or_behind_does_not_block_the_way(x_m):
    away_m = np.hypot(0.2, 0.15) + People().radius_m + 0.02  # 3 cm are kept from those ahead
    driver, pose, _, _ = driven_at([x_m, np.sqrt(away_m**2 - x_m**2)], 1)
    pose[:] = 0.0
    assert driver._allowed(0.5, 0.0) == 1.0
    pose[0] = -0.2
    assert driver._allowed(0.5, 0.0) < 1.0


def test_a_robot_that_has_waited_goes_past_somebody_beside_its_way():
    _, _, reached, _ = driven_at([2.0, 0.45], 30)
    assert reached[300 * 10] < 2.0
    assert reached[-1] > 3.0


@pytest.mark.parametrize(("heading_rad", "sideways"), [(0.0, 1), (np.pi / 2.0, 0)])
def test_those_ahead_of_a_robot_that_waits_step_aside(heading_rad, sideways):
    at = np.array([[0.8, 0.1], [0.8, -0.1], [-0.8, 0.1]])
    spots = at if sideways == 1 else at[:, ::-1] * [-1.0, 1.0]
    crowd, _ = crowd_at(np.column_stack([spots, np.zeros((3, 2))]))
    targets = spots.copy()
    asked = crowd._step_aside(0, np.array([0.0, 0.0, heading_rad]), targets)
    assert list(asked) == [True, True, False]
    moved = targets - spots
    np.testing.assert_allclose(moved[:2, sideways] * np.sign(spots[:2, sideways]), 1.0)
    np.testing.assert_allclose(moved[:2, 1 - sideways], 0.0, atol=1e-12)
    np.testing.assert_array_equal(moved[2], 0.0)


def test_what_makes_no_sense_is_said():
    with pytest.raises(InputError, match=r"people\.min_speed_mps"):
        People(min_speed_mps=2.0)
    with pytest.raises(InputError, match=r"people\.n=500.*room"):
        drive(500)
    corners = np.array([[0.0, 0.0], [0.5, 0.0], [0.5, 0.5], [0.0, 0.5]])
    walls = np.hstack([corners, np.roll(corners, -1, axis=0)])
    closet = World("closet", walls, np.tile([0.0, 2.5], (4, 1)), start_pose=np.full(3, 0.25))
    with pytest.raises(InputError, match=r"no room for people"):
        Crowd(People(n=1), closet, [ROBOT], [np.zeros(3)], np.random.default_rng(0))


def test_discs_follow_their_own_time():
    crowd, _ = crowd_at([[3.0, 0.0, 0.0, 0.0]])
    crowd._states.append(crowd._states[0] + [0.02, 0.0, 0.0, 0.02])
    stamps = np.array([0.0, 0.01, 0.02])
    x = crowd.discs(stamps, 1.2)[:, 0, 0]
    assert np.allclose(x, [3.0, 3.01, 3.02])
    ranges, _ = strike_discs(np.zeros((3, 2)), np.zeros(3), crowd.discs(stamps, 1.2))
    assert all(b > a for a, b in itertools.pairwise(ranges))
