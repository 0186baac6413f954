"""Occupancy grids: the files of ROS's map server, the type, localization on them, mapping."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

from estimators.base import Prior, run
from estimators.on_a_map.likelihood_field import FieldOptions, likelihood_field
from estimators.on_a_map.mcl import Mcl
from experiments.gate.conform import check_estimator
from experiments.runs.seeds import stream
from sim import se2
from sim.errors import InputError
from sim.sensors import Laser
from sim.worlds.grid import OccupancyGrid, of_world, rasterize
from sim.worlds.grid_file import read_grid, write_grid
from tests.fixtures.fakes import HALF_ROOM_M, circle, square_room

MAP = Path(__file__).resolve().parents[3] / "docs" / "maps" / "lab.yaml"
LASER = Laser(n_beams=90, max_range_m=30.0)
META = {
    "image": "map.pgm",
    "resolution": 0.05,
    "origin": [-1.0, 2.0, 0.0],
    "negate": 0,
    "occupied_thresh": 0.65,
    "free_thresh": 0.196,
}
STATES = np.array([[0.0, 1.0, np.nan], [0.0, 0.0, 1.0]], np.float32)  # the lower row first


def written(folder, pixels=b"P5\n3 2\n255\n" + bytes([254, 254, 0, 254, 0, 205]), **keys):
    """A grid's files, with some keys replaced; None leaves a key out."""
    meta = {key: value for key, value in {**META, **keys}.items() if value is not None}
    (folder / "map.yaml").write_text(yaml.safe_dump(meta))
    if pixels is not None:
        (folder / "map.pgm").write_bytes(pixels)
    return folder / "map.yaml"


def random_grid(seed=0, shape=(7, 11)):
    rng = np.random.default_rng(seed)
    values = np.array([0.0, 1.0, np.nan], np.float32)[rng.integers(3, size=shape)]
    return OccupancyGrid(values, 0.1, np.array([-3.0, 2.0, 0.4]))


# Files


def map_server(path):
    """The states as the map server sends them, by its own rules: 0, 100 or -1, lowest row first."""
    meta = yaml.safe_load(path.read_text())
    kind, size, most, pixels = (path.parent / meta["image"]).read_bytes().split(b"\n", 3)
    assert (kind, most, meta["mode"], meta["negate"]) == (b"P5", b"255", "trinary", 0)
    columns, rows = map(int, size.split())
    assert len(pixels) == rows * columns
    cells = np.empty((rows, columns), int)
    for i, shade in enumerate(pixels):
        p = (255 - shade) / 255.0
        cell = 100 if p > meta["occupied_thresh"] else 0 if p < meta["free_thresh"] else -1
        cells[rows - 1 - i // columns, i % columns] = cell
    return cells, meta


def test_another_reader_finds_the_same(tmp_path):
    grid = random_grid()
    write_grid(grid, tmp_path / "map.yaml")
    cells, meta = map_server(tmp_path / "map.yaml")
    np.testing.assert_array_equal(cells == 100, grid.occupied)
    np.testing.assert_array_equal(cells == 0, grid.free)
    assert (meta["resolution"], meta["origin"]) == (0.1, [-3.0, 2.0, 0.4])
    with Image.open(tmp_path / "map.pgm") as image:
        assert image.size == (11, 7)


@pytest.mark.parametrize("mode", ["trinary", "raw"])
def test_written_and_read_back(tmp_path, mode):
    grid = random_grid()
    write_grid(grid, tmp_path / "map.yaml", mode)
    back = read_grid(tmp_path / "map.yaml")
    np.testing.assert_array_equal(back.probability, grid.probability)
    assert back.resolution_m == grid.resolution_m
    np.testing.assert_array_equal(back.origin, grid.origin)


def test_raw_keeps_probabilities_in_percent(tmp_path):
    values = np.linspace(0.0, 1.0, 60, dtype=np.float32).reshape(5, 12)
    write_grid(OccupancyGrid(values, 0.1), tmp_path / "map.yaml", "raw")
    np.testing.assert_allclose(read_grid(tmp_path / "map.yaml").probability, values, atol=0.00501)


def test_the_first_row_of_the_image_is_the_top(tmp_path):
    grid = read_grid(written(tmp_path))
    np.testing.assert_array_equal(grid.probability, STATES)
    np.testing.assert_array_equal(grid.at([[-0.99, 2.01], [-0.93, 2.01]]), [0.0, 1.0])
    assert np.isnan(grid.at([[-0.86, 2.01], [-1.01, 2.01], [-0.99, 2.11]])).all()


def expected(levels, mode="trinary", negate=0):
    """Probability of shades in [0, 1], one by one."""
    out = []
    for shade in levels:
        p = shade if negate else 1.0 - shade
        if mode == "raw":
            percent = round(255 * shade)
            out.append(percent / 100 if percent <= 100 else math.nan)
        elif p > 0.65 or p < 0.196:
            out.append(float(p > 0.65))
        else:
            out.append((p - 0.196) / (0.65 - 0.196) if mode == "scale" else math.nan)
    return out


@pytest.mark.parametrize("mode", ["trinary", "scale", "raw"])
@pytest.mark.parametrize("negate", [0, 1, True])
@pytest.mark.parametrize(
    "kind", ["P5", "P2", "P5 of 16 bits", "P5 to 100", "PNG", "PNG of 16 bits"]
)
def test_images_of_all_depths(tmp_path, kind, mode, negate):
    most = 65535 if "16" in kind else 100 if "100" in kind else 255
    levels = np.array([0, 0.1, 0.2, 0.39, 0.5, 0.8, 0.81, 1.0])
    numbers = np.round(levels * most).astype(int)
    if kind.startswith("PNG"):
        kept = np.uint16 if "16" in kind else np.uint8
        Image.fromarray(numbers[None].astype(kept)).save(tmp_path / "map.png")
        path = written(tmp_path, None, image="map.png", mode=mode, negate=negate)
    else:
        head = f"{kind[:2]}\n# by hand\n8 1\n{most}\n".encode()
        plain = " ".join(map(str, numbers)).encode()
        packed = numbers.astype(">u2" if most > 255 else np.uint8).tobytes()
        path = written(
            tmp_path, head + (plain if kind == "P2" else packed), mode=mode, negate=negate
        )
    found = read_grid(path).probability[0]
    np.testing.assert_allclose(found, expected(numbers / most, mode, negate), atol=6e-3)


def test_colours_are_averaged_and_what_is_transparent_is_unknown_where_the_mode_says_so(tmp_path):
    pixels = np.array([[[0, 0, 0, 255], [255, 255, 255, 255], [0, 0, 0, 0], [255, 0, 0, 255]]])
    Image.fromarray(pixels.astype(np.uint8)).save(tmp_path / "map.png")
    scale = read_grid(written(tmp_path, None, image="map.png", mode="scale")).probability[0]
    np.testing.assert_array_equal(scale, [1.0, 0.0, np.nan, 1.0])
    # averaged with the opacity: 1/4, 1, 0 and 1/2 bright
    trinary = read_grid(written(tmp_path, None, image="map.png")).probability[0]
    np.testing.assert_array_equal(trinary, [1.0, 0.0, 1.0, np.nan])


def test_the_image_may_lie_elsewhere(tmp_path):
    inner = tmp_path / "inner"
    inner.mkdir()
    written(tmp_path)
    for image in ("../map.pgm", str(tmp_path / "map.pgm")):
        path = written(inner, None, image=image)
        np.testing.assert_array_equal(read_grid(path).probability, STATES)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"image": None}, ["image is missing"]),
        ({"resolution": None}, ["resolution is missing", "0.05"]),
        ({"origin": None}, ["origin is missing"]),
        ({"negate": None}, ["negate is missing"]),
        ({"free_thresh": None}, ["free_thresh is missing", "0.196"]),
        ({"occupied_thresh": None}, ["occupied_thresh is missing", "0.65"]),
        ({"image": 7}, ["image must be"]),
        ({"image": "none.pgm"}, ["none.pgm", "no such image"]),
        ({"image": "."}, ["not a file"]),
        ({"resolution": 0}, ["resolution must be positive"]),
        ({"resolution": -0.05}, ["resolution must be positive"]),
        ({"resolution": math.nan}, ["resolution must be a finite number"]),
        ({"resolution": "wide"}, ["resolution must be a finite number", "wide"]),
        ({"origin": [0, 0]}, ["origin must be [x, y, yaw]"]),
        ({"origin": [0, 0, math.inf]}, ["origin[2]", "finite"]),
        ({"origin": 3}, ["origin must be [x, y, yaw]"]),
        ({"negate": 2}, ["negate must be 0 or 1"]),
        ({"mode": "ternary"}, ["mode must be trinary, scale, raw"]),
        ({"free_thresh": -0.1}, ["free_thresh must be below occupied_thresh"]),
        ({"occupied_thresh": -0.65}, ["occupied_thresh, both between 0 and 1"]),
        ({"occupied_thresh": 65}, ["occupied_thresh, both between 0 and 1"]),
        ({"free_thresh": 0.9}, ["free_thresh must be below occupied_thresh"]),
        ({"free_thresh": 0.65}, ["free_thresh must be below occupied_thresh"]),
    ],
)
def test_a_wrong_key_is_named_in_one_line(tmp_path, keys, words):
    with pytest.raises(InputError) as error:
        read_grid(written(tmp_path, **keys))
    message = str(error.value)
    assert "\n" not in message
    assert str(tmp_path) in message
    for word in words:
        assert word in message


@pytest.mark.parametrize(
    ("pixels", "word"),
    [
        (b"P5\n3 2\n255\n" + bytes(5), "truncated"),
        (b"P5\n3 2\n65535\n" + bytes(7), "truncated"),
        (b"P2\n3 2\n255\n1 2 3", "truncated"),
        (b"P5\n3 2\n70000\n" + bytes(12), "no image"),
        (b"P5\n0 2\n255\n", "no image"),
        (b"Pf\n1 1\n-1.0\n" + bytes(4), "floating-point"),
        (b"", "no image"),
        (b"not an image", "no image"),
        (b"P5\n9000 9000\n255\n", "9000 x 9000 cells"),
        (b"P5\n10000 10000\n255\n", "pixels"),
        (b"P5\n2000000 2000000\n255\n", "pixels"),
    ],
)
def test_a_broken_or_huge_image_is_refused(tmp_path, pixels, word):
    with pytest.raises(InputError, match=word):
        read_grid(written(tmp_path, pixels))


@pytest.mark.parametrize("text", ["", "- 1", "{a: [}", "image: &a [*a]", "\x00", "a" * 1_000_001])
def test_what_is_no_yaml_of_a_grid_is_refused(tmp_path, text):
    path = tmp_path / "map.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=r"map\.yaml"):
        read_grid(path)
    with pytest.raises(InputError, match="cannot read"):
        read_grid(tmp_path / "none.yaml")


def test_mutated_files_are_read_or_refused(tmp_path):
    path = written(tmp_path)
    whole = [(file, file.read_bytes()) for file in (path, tmp_path / "map.pgm")]
    rng = np.random.default_rng(0)
    n_read, messages = 0, []
    for _ in range(200):
        file, good = whole[rng.integers(2)]
        bad = bytearray(good)
        for _ in range(rng.integers(1, 4)):
            bad[rng.integers(len(bad))] = rng.integers(256)
        file.write_bytes(bytes(bad[: rng.integers(1, len(bad) + 1)] if rng.random() < 0.2 else bad))
        try:
            n_read += read_grid(path).probability.size > 0
        except InputError as error:
            messages.append(str(error))
        file.write_bytes(good)
    assert 0 < n_read < 200
    assert not any("\n" in message for message in messages)


def test_a_name_that_is_not_of_a_grid_and_a_full_disk(tmp_path):
    with pytest.raises(InputError, match=r"\.yaml"):
        write_grid(random_grid(), tmp_path / "map.pgm")
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="cannot write"):
        write_grid(random_grid(), tmp_path / "file" / "map.yaml")


# The type


@pytest.mark.parametrize(
    "arguments",
    [
        (np.zeros(3, np.float32), 0.1),
        (np.zeros((0, 3), np.float32), 0.1),
        (np.full((2, 2), 1.5, np.float32), 0.1),
        (np.zeros((2, 2), np.float32), 0.0),
        (np.zeros((2, 2), np.float32), 0.1, np.zeros(2)),
    ],
)
def test_a_grid_that_makes_no_sense_is_refused(arguments):
    with pytest.raises(InputError, match="grid"):
        OccupancyGrid(*arguments)


def test_places_of_a_turned_grid():
    grid = random_grid()
    cells = np.argwhere(np.ones(grid.probability.shape, bool))
    np.testing.assert_array_equal(grid.at(grid.middles_m(cells)), grid.probability.ravel())
    motion = np.array([1.0, -2.0, 2.5])
    moved = grid.moved(motion)
    np.testing.assert_allclose(moved.corners_m, se2.transform(motion, grid.corners_m), atol=1e-12)
    np.testing.assert_array_equal(moved.at(moved.middles_m(cells)), grid.probability.ravel())


def test_walls_are_borders_in_straight_runs():
    values = np.zeros((6, 8), np.float32)
    values[2:4, 3:6] = 1.0
    block = OccupancyGrid(values, 0.5, np.array([1.0, 2.0, 0.0]))
    found = {tuple(wall) for wall in block.walls()}
    assert found == {(2.5, 3, 4, 3), (2.5, 4, 4, 4), (2.5, 3, 2.5, 4), (4, 3, 4, 4)}
    values[4, 3] = 1.0  # an L: six sides
    bent = dataclasses.replace(block, probability=values)
    assert len(bent.walls()) == 6
    turned = bent.moved([0.0, 0.0, 0.3])
    np.testing.assert_allclose(
        turned.walls().reshape(-1, 2),
        se2.transform([0.0, 0.0, 0.3], bent.walls().reshape(-1, 2)),
        atol=1e-12,
    )
    assert len(OccupancyGrid(np.ones((2, 2), np.float32), 1.0).walls()) == 4
    assert len(OccupancyGrid(np.zeros((2, 2), np.float32), 1.0).walls()) == 0


def test_a_world_as_a_grid():
    grid = rasterize(square_room(), 0.05, 0.2)
    cells = np.argwhere(np.ones(grid.probability.shape, bool))
    middles = grid.middles_m(cells)
    depth = HALF_ROOM_M - np.abs(middles).max(axis=1)  # inside the room, less than 0 outside
    state = grid.probability.ravel()
    assert np.all(state[np.abs(depth) < 0.03] == 1.0)
    assert np.all(state[depth > 0.04] == 0.0)
    assert np.isnan(state[depth < -0.04]).all()
    with pytest.raises(InputError, match="height"):
        rasterize(square_room(), 0.05, 3.0)
    with pytest.raises(InputError, match="larger"):
        rasterize(square_room(), 1e-4, 0.2)
    with pytest.raises(InputError, match="lie in walls"):
        rasterize(dataclasses.replace(square_room(), start_pose=np.full(3, 99.0)), 0.05, 0.2)


# Localization


def test_the_field_is_that_of_the_walls_to_half_a_cell():
    world = square_room()
    exact = likelihood_field(world, LASER, FieldOptions(sigma_m=0.15))
    ofgrid = likelihood_field(rasterize(world, 0.05, 0.2), LASER, FieldOptions(sigma_m=0.15))
    rng = np.random.default_rng(0)
    ends = np.ascontiguousarray(rng.uniform(-4.0, 4.0, (2, 50)).astype(np.float32))
    here = np.zeros((1, 3))
    for b in range(50):
        one = np.ascontiguousarray(ends[:, b : b + 1])
        off = exact.log_likelihood(here, one) - ofgrid.log_likelihood(here, one)
        assert abs(off[0]) < 0.5


@pytest.mark.parametrize("yaw", [0.0, 0.7])
def test_unknown_is_no_floor_and_as_likely_as_free(yaw):
    """A wall along x, free below it, unknown above; the grid may lie askew."""
    values = np.zeros((80, 120), np.float32)
    values[40], values[41:] = 1.0, np.nan
    grid = OccupancyGrid(values, 0.05, np.array([2.0, 1.0, yaw]))
    field = likelihood_field(grid, LASER, FieldOptions(cell_m=0.02, sigma_m=0.1, max_loss=3.0))

    def likelihood(y_cells):
        end = se2.transform(grid.origin, [[3.0, 0.05 * y_cells]]).T.astype(np.float32)
        at = field.log_likelihood(np.zeros((1, 3)), np.ascontiguousarray(end))[0]
        return (1.0 + math.exp(-3.0)) * math.exp(at)

    assert likelihood(40.5) == pytest.approx(1.0 + math.exp(-3.0), rel=0.05)
    for cells in (10.5, 70.5, 400.5):  # free, unknown, off the grid
        assert likelihood(cells) == pytest.approx(math.exp(-3.0), rel=0.01)
    for cells in (1.5, 3.5, 5.5):  # as much before the wall as behind it
        assert likelihood(40.5 + cells) == pytest.approx(likelihood(40.5 - cells), rel=0.3)
    drawn = field.draw(2000, np.random.default_rng(0))
    places = se2.transform(se2.inverse(grid.origin), drawn[:, :2]) / 0.05
    assert np.all((places >= -0.5) & (places[:, :2] <= [120.5, 40.5]))
    assert places[:, 1].max() < 38.5  # off the wall, too
    with pytest.raises(InputError, match="no occupied cell"):
        likelihood_field(OccupancyGrid(np.zeros((3, 3), np.float32), 0.1), LASER, FieldOptions())


def test_the_unknown_behind_a_wall_does_not_draw_the_robot_to_it():
    """Beams that err by more than sigma_m, before a wall with unknown space behind.

    At 1 / z_max there (5.6 m), and a tenth of that in free space, the likeliest pose is 12 mm too
    far forward, since ends behind the wall lose less than ends before it.
    """
    values = np.zeros((80, 120), np.float32)
    values[40], values[41:] = 1.0, np.nan
    grid = OccupancyGrid(values, 0.05, np.zeros(3))
    field = likelihood_field(grid, LASER, FieldOptions(cell_m=0.01))
    rng = np.random.default_rng(0)
    ends = np.column_stack([rng.uniform(2.0, 4.0, 20_000), rng.normal(2.025, 0.15, 20_000)])
    shifts_m = np.linspace(-0.05, 0.05, 101)
    poses = np.column_stack([np.zeros(101), shifts_m, np.zeros(101)])
    at = field.log_likelihood(poses, np.ascontiguousarray(ends.T, np.float32))
    peak = np.polyfit(shifts_m, at, 2)
    assert abs(-0.5 * peak[1] / peak[0]) < 0.004


def test_mcl_on_a_grid_is_about_as_good_as_on_walls():
    recording = circle(n_frames=200)
    errors = []
    for known in (recording.world, of_world(recording, 0.05, 0.2)):
        prior = Prior(
            recording.robot,
            recording.sensors,
            recording.truth.poses[0],
            np.diag(np.square([0.05, 0.05, 0.03])),
            known,
        )
        mcl = Mcl(max_particles=3000, kr=1e-5, kl=1e-5)
        found = run(mcl, recording, prior, stream(0, "estimator/mcl"))
        errors.append(np.hypot(*(found.means - recording.truth.poses)[:, :2].T))
    rms = [math.sqrt(np.mean(np.square(error))) for error in errors]
    assert rms[1] < max(1.3 * rms[0], 0.02)


@pytest.mark.slow
def test_mcl_conforms_on_a_grid():
    recording = circle(n_frames=60)
    known, sigma = of_world(recording, 0.05, 0.2), np.array([0.02, 0.02, 0.01])
    start = recording.truth.poses[0], np.diag(np.square(sigma))
    prior = Prior(recording.robot, recording.sensors, *start, known)
    for result in check_estimator(lambda: Mcl(max_particles=2000), recording, prior):
        assert result.passed, f"{result.name}: {result.message}"


# Mapping
