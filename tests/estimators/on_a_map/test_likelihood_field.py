"""The likelihood field against its formula, worked out slowly."""

import dataclasses
import math

import numpy as np
import pytest

from estimators.on_a_map.likelihood_field import FieldOptions, beam_ends, likelihood_field
from sim import se2
from sim.errors import InputError
from sim.sensors import Laser, Mount
from sim.worlds.world import World
from tests.estimators.laser.test_icp import ROOM

LASER = Laser(n_beams=90, max_range_m=30.0, mount=Mount(x_m=0.2, y_m=-0.1, z_m=0.3, yaw_rad=0.4))
SIGMA_M, MAX_LOSS = 0.15, 3.0


def world(walls=ROOM, heights=(0.0, 1.0)):
    return World("room", walls, np.tile(heights, (len(walls), 1)))


def field(cell_m=0.1, **options):
    given = {"sigma_m": SIGMA_M, "max_loss": MAX_LOSS, **options}
    return likelihood_field(world(), LASER, FieldOptions(cell_m=cell_m, **given))


def log_p(points):
    """The mixture at points (N, 2), straight from the distances to the walls."""
    distances = np.array([world().clearance_m(point) for point in points])
    return np.log(np.exp(-0.5 * (distances / SIGMA_M) ** 2) + math.exp(-MAX_LOSS))


def test_cells_hold_the_mixture_at_their_middle():
    made = field()
    rng = np.random.default_rng(0)
    rows, columns = made.table.shape
    cells = np.column_stack([rng.integers(rows, size=400), rng.integers(columns, size=400)])
    middles = made.origin_m + (cells[:, ::-1] + 0.5) * made.cell_m
    at_wall = math.log1p(math.exp(-MAX_LOSS))
    table = made.table[cells[:, 0], cells[:, 1]]
    np.testing.assert_allclose(-made.step * table, log_p(middles) - at_wall, atol=2e-3)
    rim = np.concatenate([made.table[[0, -1]].ravel(), made.table[:, [0, -1]].ravel()])
    assert rim.min() > 0.999 * 65535


def test_a_scan_is_the_sum_over_its_beams():
    """Also at poses off the map, whose beams count as ending anywhere."""
    made = field(0.05)
    rng = np.random.default_rng(1)
    poses = np.column_stack(
        [rng.uniform(-4, 6, 60), rng.uniform(-3, 5, 60), rng.uniform(-9, 9, 60)]
    )
    poses[0, :2] = [1e5, -1e5]
    for n_beams in (1, 3, 4, 61, 90):
        ends = beam_ends(rng.uniform(0.5, 6.0, 90).astype(np.float32), LASER, n_beams)
        assert ends.shape == (2, n_beams)
        slow = []
        for pose in poses:
            at = np.floor((se2.transform(pose, ends.T) - made.origin_m) / made.cell_m).astype(int)
            at = np.clip(at, 0, np.array(made.table.shape)[::-1] - 1)
            slow.append(-made.step * made.table[at[:, 1], at[:, 0]].astype(float).sum())
        # single precision moves a beam's end over a cell's edge now and then
        off = np.abs(made.log_likelihood(poses, ends) - slow)
        assert np.quantile(off, 0.8) < 1e-6 * n_beams
        assert off.max() < 1.5
    assert made.log_likelihood(poses, ends)[0] == pytest.approx(-made.step * 65535 * 90)


def test_the_true_pose_is_likeliest():
    made = field(0.05)
    pose = np.array([0.5, 0.7, 0.3])
    from experiments.evaluation.scan_bound import cast

    ranges = cast(ROOM, se2.compose(pose, LASER.mount.pose), LASER.bearings_rad)[0]
    ends = beam_ends(ranges.astype(np.float32), LASER, 90)
    rng = np.random.default_rng(2)
    others = pose + rng.standard_normal((500, 3)) * [0.5, 0.5, 0.3]
    others = others[np.abs(others - pose).max(axis=1) > 0.15]
    best, rest = made.log_likelihood(pose[None], ends)[0], made.log_likelihood(others, ends)
    assert best > rest.max()
    assert best / 90 > -0.2


def test_beams_end_where_they_do():
    ranges = np.full(90, 3.0, np.float32)
    ranges[[10, 40]], ranges[50], ranges[60] = np.inf, 0.01, np.nan
    ends = beam_ends(ranges, LASER, 90)
    assert ends.dtype == np.float32
    assert ends.shape == (2, 86)
    eye = LASER.mount.pose
    away = ends.T - eye[:2]
    np.testing.assert_allclose(np.hypot(*away.T), 3.0, rtol=1e-6)
    assert math.atan2(away[0, 1], away[0, 0]) == pytest.approx(-math.pi / 2 + 0.4, abs=1e-6)
    few = beam_ends(np.full(90, 3.0, np.float32), LASER, 30)
    assert few.shape == (2, 30)
    bearings = np.unwrap(np.arctan2(*(few.T - eye[:2]).T[::-1])) - 0.4
    np.testing.assert_allclose(np.diff(bearings), 3.0 * np.diff(LASER.bearings_rad)[0], rtol=1e-4)
    assert abs(bearings.mean()) < 0.03  # even about the middle


def test_free_floor():
    """Inside the room, off the walls, and not inside the boxes in it."""
    made = field()
    rng = np.random.default_rng(3)
    poses = made.draw(4000, rng)
    clearances = np.array([world().clearance_m(pose[:2]) for pose in poses])
    assert clearances.min() > 0.15 - made.cell_m
    assert np.all((poses[:, :2] > [-3, -2]) & (poses[:, :2] < [5, 4]))
    in_box = np.all((poses[:, :2] > [-1.0, 2.5]) & (poses[:, :2] < [0.2, 3.1]), axis=1)
    assert not in_box.any()
    area_m2 = len(made.free_cells) * made.cell_m**2
    assert 38.0 < area_m2 < 46.0  # 48, less the boxes and the strips along walls
    quarters = np.histogram(poses[:, 2], bins=4, range=(-math.pi, math.pi))[0]
    assert quarters.min() > 900


def test_only_walls_at_the_lasers_height_count():
    low = world(heights=(0.0, 0.2))
    with pytest.raises(InputError, match=r"0\.3 m"):
        likelihood_field(low, LASER, FieldOptions())
    high = dataclasses.replace(LASER, mount=Mount(z_m=0.1))
    assert likelihood_field(low, high, FieldOptions(sigma_m=0.1)).table.min() < 6000


def test_too_fine_a_table_is_refused():
    for cell_m in (1e-4, 4e-10, 1e-300):  # whose cells int64 would not count
        with pytest.raises(InputError, match=r"cell_m=.* cells of world room; make it larger"):
            field(cell_m=cell_m)
    with pytest.raises(InputError, match=r"cell_m=0\.05 makes inf cells"):
        likelihood_field(world(ROOM * 1e300), LASER, FieldOptions())
