"""Worlds without straight walls, and maps of another day."""

import dataclasses
import itertools

import numpy as np
import pytest

from sim.errors import InputError
from sim.robot.drive import DifferentialDrive
from sim.routes.route import Tour
from sim.sensors import Laser, Mount
from sim.sensors.rays import ExactRays
from sim.simulate import Member, record
from sim.worlds.buildings import Rooms, boxes, office, room
from sim.worlds.floor_plan import CHORD_ERROR_M, arc_points, gaps_m, inside, round_corners
from sim.worlds.irregular import Clutter, CorridorsAlike, Curved, Hall, Polygon
from sim.worlds.posts import Orchard, Warehouse

KINDS = (Clutter, Curved, CorridorsAlike, Hall, Polygon, Orchard, Warehouse)
ROBOT = DifferentialDrive(wheel_radius_m=0.1, track_m=0.38, body_length_m=0.48, body_width_m=0.36)


def built(kind, seed=0, **options):
    return kind(n_landmarks=0, **options).build(np.random.default_rng(seed))


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", [0, 1])
def test_tours_keep_clear_and_can_be_driven(kind, seed):
    world = built(kind, seed)
    legs = np.hstack([world.waypoints[:-1], world.waypoints[1:]])
    low = world.wall_z_m[:, 0] < 1.0
    assert gaps_m(legs, world.walls[low]).min() > 0.5
    streams = {a: np.random.default_rng([seed, i]) for i, a in enumerate(("slip", "sensors"))}
    member = Member(ROBOT, {"laser": Laser(n_beams=9)}, Tour(distance_m=60.0), streams)
    assert record(world, member, physics="kinematic", rays="exact").status == "ok"


def test_chords_are_off_the_circle_by_less_than_a_tenth_of_a_millimetre():
    for radius in (0.0125, 0.3, 1.6, 60.0):
        ring = round_corners((1.0, 2.0), radius)
        middles = (ring + np.roll(ring, 1, axis=0)) / 2 - (1.0, 2.0)
        assert radius - np.hypot(*middles.T).min() < CHORD_ERROR_M
        arc = arc_points((0.0, 0.0), radius, (0.3, 0.9))
        middles = (arc[1:] + arc[:-1]) / 2
        assert radius - np.hypot(*middles.T).min() < CHORD_ERROR_M
        assert np.allclose(
            arc[[0, -1]], radius * np.array([[np.cos(a), np.sin(a)] for a in (0.3, 0.9)])
        )


@pytest.mark.parametrize("seed", range(4))
def test_things_stand_within_the_walls(seed):
    world = built(Polygon, seed)
    outline = world.walls[: Polygon().n_sides, :2]
    assert inside(world.walls[Polygon().n_sides :, :2], outline).all()


def test_tables_are_legs_to_a_laser():
    world = built(Clutter, n_tables=1, chairs_per_table=0, n_plants=0, n_boxes=0)
    low = (world.wall_z_m[:, 0] <= 0.25) & (world.wall_z_m[:, 1] >= 0.25)
    assert low.sum() == 4 + 4 * 4  # the hall's walls, and four legs
    assert (~low).sum() == 4  # the top


def test_corridors_look_alike_until_some_cabinets_differ():
    world = built(CorridorsAlike)
    laser = Laser(n_beams=181, max_range_m=6.0, mount=Mount(z_m=0.25))

    def scans(world):
        feet = [area[0, 1] for name, area in sorted(world.places.items())]
        rays = ExactRays(world)
        return [rays.scan(laser, np.array([9.0, foot + 1.1, 0.0])) for foot in feet]

    assert all(np.allclose(a, b) for a, b in itertools.pairwise(scans(world)))
    differing = scans(built(CorridorsAlike, differing_share=1.0))
    assert not all(np.allclose(a, b) for a, b in itertools.pairwise(differing))
    feet = np.sort([area[0, 1] for area in world.places.values()])
    assert np.ptp(np.diff(feet)) > 0.5  # at unequal distances


def test_the_walls_of_the_hall_are_out_of_range():
    world = built(Hall)
    walls = dataclasses.replace(world, walls=world.walls[:4], wall_z_m=world.wall_z_m[:4])
    assert min(map(walls.clearance_m, world.waypoints)) > 80.0
    seen = ExactRays(world).scan(Laser(fov_rad=2.0 * np.pi), np.array([*world.waypoints[0], 0.0]))
    assert 0.0 < np.isfinite(seen).mean() < 0.5


@pytest.mark.parametrize("kind", [Clutter, Curved, CorridorsAlike, Hall, Rooms])
def test_a_map_of_another_day_has_the_same_walls(kind):
    today, changed = built(kind), built(kind, changed_share=0.5)
    assert np.array_equal(today.walls, changed.walls)
    assert today.known is today
    known = changed.known
    assert known.known_walls is None
    mine, other = ({tuple(face) for face in world.walls} for world in (today, known))
    assert mine - other
    assert other - mine
    gone = np.array([tuple(face) not in other for face in today.walls])
    assert 0.05 < gone.mean() < 0.7
    tall = today.wall_z_m[:, 1] == 2.5  # walls, not furniture
    if kind is not Curved:  # whose pillars are as high
        assert not gone[tall].any()


@pytest.mark.parametrize("build", [room, boxes, office])
def test_the_share_that_has_changed_is_the_one_asked_for(build):
    def faces(share):
        world = build(rng=np.random.default_rng(4), changed_share=share)
        return world, {tuple(face) for face in world.known.walls}

    world, same = faces(0.0)
    drawn = {tuple(face) for face in world.walls}
    assert same == drawn
    assert world.known_walls is None
    world, known = faces(1.0)
    n_objects = {room: 6, boxes: 12}.get(build)
    if n_objects:  # a third moved, a third missing, a third doubled, four faces each
        assert len(drawn - known) == 4 * round(2 * n_objects / 3)
        assert len(known - drawn) == 4 * round(2 * n_objects / 3)
    with pytest.raises(InputError, match="changed_share"):
        faces(1.5)


def test_glass_and_dark_walls_make_up_their_shares():
    rooms = {"n_x": 10, "n_y": 10, "objects_per_room": 1}
    world = Rooms(**rooms, glass_share=0.4, dark_share=0.2).build(np.random.default_rng(0))
    plain = Rooms(**rooms).build(np.random.default_rng(0))
    assert np.array_equal(world.walls, plain.walls)
    assert plain.materials is None
    objects = world.wall_z_m[:, 1] != 2.5
    assert not world.materials[objects].any()
    shares = np.bincount(world.materials[~objects], minlength=3) / (~objects).sum()
    assert np.allclose(shares, [0.4, 0.4, 0.2], atol=0.08)
    with pytest.raises(InputError, match="glass_share"):
        Rooms(glass_share=0.8, dark_share=0.8).build(np.random.default_rng(0))
