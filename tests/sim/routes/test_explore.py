"""Exploration: frontiers, what is seen from them, ways to them, and robots that drive to them."""

import math

import numpy as np
import pytest

from sim.errors import InputError
from sim.robot.drive import DifferentialDrive
from sim.routes.explore import Explore
from sim.routes.frontiers import Ways, frontiers, in_sight, middle_of, nearest, unknown_in_sight
from sim.sensors import Encoder, Laser
from sim.simulate import Member, record_team
from sim.worlds.buildings import Rooms

ROBOT = DifferentialDrive(
    wheel_radius_m=0.1, track_m=0.4, kr=0.0, kl=0.0, body_length_m=0.4, body_width_m=0.32
)
SENSORS = {
    "encoder": Encoder(rate_hz=5.0),
    "laser": Laser(
        rate_hz=5.0, n_beams=180, fov_rad=2.0 * math.pi, max_range_m=5.0, sigma_range_m=0.01
    ),
}


def grid(*rows):
    """Masks free, occupied and unknown of a map drawn with . # and ?."""
    cells = np.array([list(row) for row in rows])
    return cells == ".", cells == "#", cells == "?"


def test_a_frontier_is_a_run_of_free_cells_beside_unknown_ones():
    free, _, unknown = grid(
        "....??",
        "....??",
        "..####",
        ".?....",
    )
    found = frontiers(free, unknown, 1)
    assert [cells.tolist() for cells in found] == [[[0, 3], [1, 3]], [[2, 1], [3, 0], [3, 2]]]
    assert len(frontiers(free, unknown, 3)) == 1
    assert middle_of(np.array([[0, 0], [0, 1], [0, 5]])).tolist() == [0, 1]


def test_unknown_cells_behind_walls_are_not_in_sight():
    _, occupied, unknown = grid(
        "???????",
        "#######",
        ".......",
        "???????",
    )
    assert unknown_in_sight(occupied, unknown, np.array([2, 3]), 10.0) == 7
    assert unknown_in_sight(occupied, unknown, np.array([2, 3]), 1.0) in (1, 3)
    open_to_both = np.zeros_like(occupied)
    assert unknown_in_sight(open_to_both, unknown, np.array([2, 3]), 10.0) == 14


def test_the_chance_to_be_seen_falls_with_the_distance_and_is_none_behind_walls():
    _, occupied, _ = grid(
        "..........",
        "..........",
        "#####.....",
        "..........",
    )
    others = np.array([[0, 0], [0, 5], [0, 9], [3, 0]])
    chance = in_sight(occupied, np.array([0, 0]), others, 9.0)
    assert chance == pytest.approx([1.0, 1.0 - 5.0 / 9.0, 0.0, 0.0])


def test_ways_are_shortest_and_go_round_what_stands_there():
    rng = np.random.default_rng(3)
    passable = rng.random((12, 15)) < 0.75
    passable[0, 0] = passable[-1, -1] = True
    ways = Ways.over(passable, np.array([[0, 0], [11, 14]]))
    cost = np.where(passable, np.inf, np.nan)
    cost[0, 0] = 0.0
    for _ in range(passable.size):  # Bellman-Ford, as an independent answer
        for down in (-1, 0, 1):
            for right in (-1, 0, 1):
                if down or right:
                    moved = np.full_like(cost, np.inf)
                    a, b = (
                        slice(max(down, 0), 12 + min(down, 0)),
                        slice(max(right, 0), 15 + min(right, 0)),
                    )
                    c, d = (
                        slice(max(-down, 0), 12 + min(-down, 0)),
                        slice(max(-right, 0), 15 + min(-right, 0)),
                    )
                    moved[a, b] = np.nan_to_num(cost[c, d], nan=np.inf) + math.hypot(down, right)
                    cost = np.where(passable, np.fmin(cost, moved), np.nan)
    assert ways.cost[0][passable] == pytest.approx(cost[passable])
    if np.isfinite(cost[-1, -1]):
        way = ways.to(0, np.array([11, 14]))
        assert way[[0, -1]].tolist() == [[0, 0], [11, 14]]
        assert passable[way[:, 0], way[:, 1]].all()
        steps = np.hypot(*np.diff(way, axis=0).T)
        assert steps.max() < 1.5
        assert steps.sum() == pytest.approx(cost[-1, -1])


def test_the_nearest_cell_of_a_mask():
    mask = np.zeros((5, 5), bool)
    mask[0, 0] = mask[4, 4] = True
    assert nearest(mask, np.array([[1, 1], [3, 4]])).tolist() == [[0, 0], [4, 4]]


def world():
    options = Rooms(
        n_x=2, n_y=2, room_m=4.0, door_m=1.6, objects_per_room=0, n_landmarks=0, on_walls_share=1.0
    )
    return options.build(np.random.default_rng(0))


def explored(strategy, n_robots=2, distance_m=12.0, **changes):
    members = []
    for number in range(n_robots):
        route = Explore(
            strategy=strategy, distance_m=distance_m, start_offset_m=(0.0, 0.8 * number), **changes
        )
        streams = {k: np.random.default_rng([number, k == "slip"]) for k in ("slip", "sensors")}
        members.append(Member(ROBOT, SENSORS, route, streams))
    return record_team(world(), members, physics="kinematic", rays="exact")


def visited(team):
    """Rooms (2 x 2) that some robot has been in."""
    poses = np.concatenate([robot.known_truth.poses for robot in team.robots])
    return {(int(x // 4.0), int(y // 4.0)) for x, y, _ in poses}


@pytest.mark.parametrize(
    "strategy",
    ["random", "nearest_frontier", "shared_frontiers", "information_gain", "coordinated"],
)
def test_robots_explore_and_hit_nothing(strategy):
    team = explored(strategy, distance_m=8.0)
    assert [robot.status for robot in team.robots] == ["ok", "ok"]
    assert len(visited(team)) >= 2


def test_a_robot_alone_explores_until_no_frontier_is_left():
    alone = explored("nearest_frontier", n_robots=1, distance_m=60.0)
    [robot] = alone.robots
    steps_m = np.hypot(*np.diff(robot.known_truth.poses[:, :2], axis=0).T)
    assert robot.status == "ok"
    assert 4.0 < steps_m.sum() < 40.0


def test_an_exploration_is_the_same_again_and_follows_its_draw():
    first, again = (explored("random", distance_m=5.0, draw=4) for _ in range(2))
    other = explored("random", distance_m=5.0, draw=5)
    poses = [team.robots[0].known_truth.poses for team in (first, again, other)]
    assert np.array_equal(poses[0], poses[1])
    assert not np.array_equal(poses[0], poses[2])


def test_what_makes_no_sense_is_refused():
    with pytest.raises(InputError, match=r"route\.strategy must be one of random"):
        Explore(strategy="best", distance_m=10.0)
    with pytest.raises(InputError, match=r"route\.decay_m"):
        Explore(strategy="random", distance_m=10.0, decay_m=0.0)
    with pytest.raises(InputError, match=r"route\.laser: no sensor named lidar"):
        explored("random", laser="lidar")
    mixed = [
        Member(
            ROBOT,
            SENSORS,
            Explore(strategy=strategy, distance_m=5.0, start_offset_m=(offset_m, 0.0)),
            {k: np.random.default_rng(0) for k in ("slip", "sensors")},
        )
        for strategy, offset_m in (("random", 0.0), ("coordinated", 0.6))
    ]
    with pytest.raises(InputError, match="differ in start_offset_m and feedback alone"):
        record_team(world(), mixed, physics="kinematic", rays="exact")
