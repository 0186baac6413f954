"""World: places, clearance, bounds and refusals; its drawing."""

import numpy as np
import pytest

from experiments.runs.experiment import Experiment
from experiments.viewing.style import figure, save_figure
from experiments.viewing.world import draw_world, world_figure
from sim.errors import InputError
from sim.worlds.world import World

WALLS = np.array([[0.0, 0, 4, 0], [4, 0, 4, 3]])
HEIGHTS = np.array([[0.0, 2.5], [0.0, 1.0]])


def test_place_is_the_first_that_holds_the_point():
    places = {
        "door": np.array([[1.0, 0, 2, 1]]),
        "room": np.array([[0.0, 0, 4, 3], [9, 9, 10, 10]]),
    }
    world = World("w", WALLS, HEIGHTS, places=places)
    points = np.array([[1.5, 0.5], [3, 2], [9.5, 9.5], [5, 5]])
    assert world.place_of(points).tolist() == ["door", "room", "room", ""]
    assert World("w", WALLS, HEIGHTS).place_of(points).tolist() == [""] * 4


def test_clearance_is_the_distance_to_the_nearest_face():
    world = World("w", WALLS, HEIGHTS)
    assert world.clearance_m(np.array([1.0, 2.0])) == pytest.approx(2.0)
    assert world.clearance_m(np.array([-3.0, 4.0])) == pytest.approx(5.0)  # to an end
    assert world.clearance_m(np.array([3.5, 1.0])) == pytest.approx(0.5)
    empty = World("w", np.zeros((0, 4)), np.zeros((0, 2)))
    assert empty.clearance_m(np.zeros(2)) == np.inf


def test_bounds_hold_everything():
    world = World(
        "w",
        WALLS,
        HEIGHTS,
        landmarks=np.array([[5.0, 1, 1]]),
        start_pose=np.array([-1.0, 1, 0]),
        waypoints=np.array([[0.0, -2], [1, 7]]),
    )
    assert world.bounds_m.tolist() == [-1.0, -2.0, 5.0, 7.0]


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"walls": np.zeros((2, 3))}, r"walls must have shape \(2, 4\)"),
        ({"walls": WALLS * [1, 1, np.nan, 1]}, "walls must be finite"),
        ({"walls": np.array([[0.0, 0, 1, 0], [2, 2, 2, 2]])}, "wall 1 has no length"),
        ({"wall_z_m": HEIGHTS[:, ::-1]}, "wall 0 has its top below its bottom"),
        ({"places": {"room": np.zeros((1, 3))}}, "places.room must have shape"),
        ({"landmarks": np.zeros((2, 3)), "descriptors": np.zeros((1, 8), np.float32)}, "1 desc"),
    ],
)
def test_a_world_that_makes_no_sense_is_refused(fields, message):
    with pytest.raises(InputError, match=message):
        World(**{"name": "w", "walls": WALLS, "wall_z_m": HEIGHTS, **fields})


def test_drawing_shows_what_is_asked_for(tmp_path):
    world = Experiment.compose(["world=office", "world.n_landmarks=50"]).world()
    ax = figure(4.0, 3.0).subplots()
    draw_world(ax, world)
    labels = ax.get_legend_handles_labels()[1]
    assert labels == ["landmark", "look-alike"]
    drawn = sum(len(c.get_segments()) for c in ax.collections)
    assert drawn == len(world.walls)
    draw_world(ax, world, landmarks=False, places=True, tour=True)
    named = [name.replace("_", ", ") for name in world.places]
    assert set(ax.get_legend_handles_labels()[1]) == {*labels, *named, "tour", "start"}
    x, y = ax.get_xlim(), ax.get_ylim()
    assert x[0] <= 0.0
    assert x[1] >= 66.0
    assert y[1] >= 42.0
    save_figure(world_figure(world), tmp_path / "w.png")
    assert (tmp_path / "w.png").stat().st_size > 10_000


def test_an_empty_world_can_be_drawn(tmp_path):
    save_figure(world_figure(World("w", np.zeros((0, 4)), np.zeros((0, 2)))), tmp_path / "w.svg")
