"""Grids made of scans, worlds made of grids, and both by the command line."""

import dataclasses
import math
import shutil

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from experiments.cli.main import app
from experiments.runs.dependencies.digests import changed
from experiments.runs.dependencies.recorder import recorded
from experiments.runs.experiment import Experiment
from experiments.viewing.animation import pictures
from experiments.viewing.map import grid_along, path_of
from experiments.viewing.playback import Playback
from sim.errors import InputError
from sim.recording import save
from sim.team import Team
from sim.worlds.buildings import from_grid
from sim.worlds.floor_plan import gaps_m
from sim.worlds.grid import rasterize
from sim.worlds.grid_mapping import _between, map_scans
from tests.experiments.cli.test_cli import called, refused
from tests.fixtures.fakes import HALF_ROOM_M, circle, square_room
from tests.sim.worlds.test_grid import LASER, MAP


def test_cells_between_two_points_are_those_of_a_fine_walk():
    rng = np.random.default_rng(0)
    cells = np.empty((200, 2), np.int64)
    for _ in range(200):
        start, end = rng.uniform(1.0, 40.0, (2, 2))
        if rng.random() < 0.2:
            end[rng.integers(2)] = start[rng.integers(2)]
        n = _between(start, end, cells)
        walked = np.linspace(start, end, 4001).astype(int)[:, ::-1]
        crossed = {tuple(cell) for cell in walked}
        found = {tuple(cell) for cell in cells[:n]}
        assert crossed <= found
        assert len(found) == n
        assert len(found - crossed) <= 1  # a corner that the walk has cut
        assert np.abs(np.diff(cells[:n], axis=0)).sum(axis=1).max(initial=1) == 1


@pytest.mark.parametrize("resolution_m", [0.05, 0.1])
def test_the_map_of_a_room(resolution_m):
    recording = circle(n_frames=150, n_beams=361)
    grid, n_scans = grid_along(
        recording, *path_of(recording, "truth", [], None), resolution_m=resolution_m
    )
    assert n_scans == 150
    middles = grid.middles_m(np.argwhere(grid.occupied))
    assert np.abs(np.abs(middles).max(axis=1) - HALF_ROOM_M).max() < resolution_m
    free = grid.middles_m(np.argwhere(grid.free))
    assert np.abs(free).max() < HALF_ROOM_M
    inside = rasterize(square_room(), resolution_m, 0.2)
    assert grid.free.sum() > 0.95 * inside.free.sum()
    sides = np.concatenate(
        [[(x, y), (y, x)] for x in np.arange(-3.9, 3.9, 0.1) for y in (-HALF_ROOM_M, HALF_ROOM_M)]
    )
    near = [grid.at(sides + step) for step in resolution_m * np.array([[-0.5, -0.5], [0.5, 0.5]])]
    assert np.mean(np.maximum(*near) > 0.65) > 0.95  # the walls have no holes


def test_beams_without_a_return_say_nothing_and_long_ones_only_clear():
    laser = dataclasses.replace(LASER, n_beams=3, fov_rad=math.pi)
    poses, ranges = np.zeros((5, 3)), np.tile(np.float32([np.inf, 4.0, 1.0]), (5, 1))
    grid = map_scans(poses, ranges, laser, resolution_m=0.1, max_range_m=2.0)
    x, y, _ = laser.mount.pose
    assert grid.at([[x + 1.5, y + 0.01], [x + 0.01, y + 0.5]]).max() < 0.2
    assert np.isnan(grid.at([[x + 2.5, y], [x, y - 0.5]])).all()
    assert grid.at([[x + 0.01, y + 1.01]])[0] > 0.9
    assert grid.occupied.sum() == 1
    with pytest.raises(InputError, match="no scan has a return"):
        map_scans(poses, np.full((5, 3), np.inf, np.float32), laser, resolution_m=0.1)
    with pytest.raises(InputError, match="diverged"):
        map_scans(poses + np.arange(5)[:, None] * 1e6, ranges, laser, resolution_m=0.1)
    with pytest.raises(InputError, match="resolution"):
        map_scans(poses, ranges, laser, resolution_m=math.nan)


def test_scans_that_the_path_does_not_reach_are_left_out():
    recording = circle(n_frames=60)
    stamps, poses = path_of(recording, "truth", [], None)
    _, n_scans = grid_along(recording, stamps[:31], poses[:31], resolution_m=0.1)
    assert n_scans == 31
    with pytest.raises(InputError, match="two poses"):
        grid_along(recording, stamps[:1], poses[:1], resolution_m=0.1)
    with pytest.raises(InputError, match="time span"):
        grid_along(recording, stamps + 99.0, poses, resolution_m=0.1)
    with pytest.raises(InputError, match="no truth"):
        path_of(dataclasses.replace(recording, truth=None), "truth", [], None)
    with pytest.raises(InputError, match="run now"):
        path_of(recording, "truth", ["robot.kr=1"], None)


# In experiments


def copied(folder):
    for name in ("lab.yaml", "lab.pgm"):
        shutil.copy(MAP.parent / name, folder)
    return folder / "lab.yaml"


GRID_RUN = ["estimator=mcl", "sensors=hokuyo", "simulation.physics=kinematic"]


def test_what_reads_a_grid_depends_on_its_image(tmp_path):
    path = copied(tmp_path)
    known = Experiment.compose([*GRID_RUN, f"prior.map={path}"])
    world = Experiment.compose(["world=from_grid", f"world.path={path}"])
    target = f"prior.map={{_target_: sim.worlds.grid_file.read_grid, path: {path}}}"
    made = Experiment.compose([*GRID_RUN, target])
    image = path.with_suffix(".pgm")
    seen = []
    for read in (known.check, world.world, lambda: made._map(None)):
        with recorded() as found:
            read()
        seen.append(found.digests())
        assert {str(path), str(image)} <= set(seen[-1])
    image.write_bytes(image.read_bytes()[:-1] + b"\0")
    assert [changed(each) for each in seen] == [[str(image)]] * 3


def test_an_estimator_that_cannot_use_a_grid_refuses_it_before_any_run():
    overrides = ["estimator=topological_mcl", "sensors=lidar3d", f"prior.map={MAP}"]
    with pytest.raises(InputError, match=r"TopologicalMap.*occupancy grid"):
        Experiment.compose(overrides).check()
    with pytest.raises(InputError, match="cannot read"):
        Experiment.compose([*GRID_RUN, "prior.map=none.yaml"]).check()
    with pytest.raises(InputError, match=r"prior\.map must be"):
        Experiment.compose([*GRID_RUN, "prior.map=map.pgm"]).check()


def test_a_world_drawn_from_a_grid():
    tour = [[1, 1], [4, 1], [4, 5]]
    world = from_grid(rng=np.random.default_rng(0), path=str(MAP), waypoints=tour)
    np.testing.assert_allclose(world.start_pose, [1.0, 1.0, 0.0])
    np.testing.assert_allclose(world.bounds_m, [-0.05, -0.05, 8.05, 6.05], atol=1e-9)
    with pytest.raises(InputError, match="runs through a wall"):
        from_grid(rng=np.random.default_rng(0), path=str(MAP), waypoints=[[1, 1], [7, 1]])
    with pytest.raises(InputError, match="waypoints"):
        from_grid(rng=np.random.default_rng(0), path=str(MAP), waypoints=[[1, "x"]])
    with pytest.raises(InputError, match=r"world\.path must name"):
        Experiment.compose(["world=from_grid"]).world()
    without = Experiment.compose(
        ["world=from_grid", f"world.path={MAP}", "simulation.physics=kinematic"]
    )
    with pytest.raises(InputError, match=r"no tour.*route\.waypoints"):
        without.simulate()


def test_map_and_run_and_view_by_the_command_line(tmp_path):
    log, out = tmp_path / "run.npz", tmp_path / "map.yaml"
    save(circle(n_frames=40, n_beams=61), log)
    done = CliRunner().invoke(app, ["map", str(log), "-e", "odometry", "-o", str(out), "--raw"])
    assert done.exit_code == 0, done.output
    assert "from 40 of 40 scans" in done.output
    assert yaml.safe_load(out.read_text())["mode"] == "raw"
    done = CliRunner().invoke(app, ["view", "--map", str(out), "-o", str(tmp_path / "map.png")])
    assert done.exit_code == 0, done.output
    assert (tmp_path / "map.png").stat().st_size > 5000
    gif = tmp_path / "run.gif"
    done = CliRunner().invoke(
        app, ["view", str(log), "--map", str(out), "-o", str(gif), "--seconds", "0.2"]
    )
    assert done.exit_code == 0, done.output
    assert gif.exists()


def test_the_grid_is_drawn_under_the_run():
    recording = circle(n_frames=10, n_beams=61)
    grid, _ = grid_along(recording, *path_of(recording, "truth", [], None), resolution_m=0.1)
    bare = Playback.of(Team((recording,)), 2)
    with_grid = dataclasses.replace(bare, grid=grid)
    unknown = [np.all(next(pictures(shown)) == 222, axis=2) for shown in (bare, with_grid)]
    assert unknown[0].mean() < 0.001
    assert unknown[1].mean() > 0.05


def test_what_the_command_line_refuses(tmp_path):
    log = tmp_path / "run.npz"
    save(dataclasses.replace(circle(n_frames=10, n_beams=61), truth=None), log)
    out = str(tmp_path / "map.yaml")
    refused(called("map", str(log), "-o", out), "no truth", "name an estimator")
    for words, said in (
        (["map", str(log), "-o", "map.pgm"], "a .yaml file"),
        (["map", "seed=3", "-o", out], "name a recording"),
        (["map", str(log), "-o", out, "seed=3"], "run now"),
        (["view", str(log), "-e", "odometry", "--map", str(MAP)], "run.html"),
        (["view", "--world", "--map", str(MAP)], "one at a time"),
    ):
        error = CliRunner().invoke(app, words).exception
        assert isinstance(error, InputError)
        assert said in str(error)


def test_a_tour_is_planned_through_a_grid_without_way_points():
    world = from_grid(rng=np.random.default_rng(0), path=str(MAP), stops=5)
    legs = np.hstack([world.waypoints[:-1], world.waypoints[1:]])
    assert gaps_m(legs, world.walls).min() > 0.4
    assert np.array_equal(world.waypoints[0], world.waypoints[-1])
    again = from_grid(rng=np.random.default_rng(1), path=str(MAP), stops=5)
    assert not np.array_equal(world.waypoints[0], again.waypoints[0])
    with pytest.raises(InputError, match="stops"):
        from_grid(rng=np.random.default_rng(0), path=str(MAP), stops=1)
