"""The fit of a scan to the walls of a map, against SciPy and against its own covariance."""

import dataclasses

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2

from estimators.gaussian import Gaussian
from estimators.on_a_map.likelihood_field import FieldOptions, likelihood_field
from estimators.on_a_map.wall_fit import WallFit
from experiments.evaluation.scan_bound import cast
from sim import se2
from sim.sensors import Laser, Mount
from sim.worlds.grid import rasterize
from sim.worlds.world import World
from tests.estimators.laser.test_icp import ROOM

LASER = Laser(n_beams=361, sigma_range_m=0.01, mount=Mount(x_m=0.2, y_m=-0.1, yaw_rad=0.4))
MAP = World("room", ROOM, np.tile([0.0, 2.0], (len(ROOM), 1)))
SPREAD = np.diag([0.02, 0.02, 0.02]) ** 2
STEADY = np.zeros((3, 3))  # wheels that never slip


def fitter(laser=LASER, known_map=MAP):
    return WallFit(likelihood_field(known_map, laser, FieldOptions()), known_map, laser)


def measured(pose, rng, laser=LASER, slip=None, bias_m=0.0):
    """Ranges from a pose; of a laser that sweeps, past the stamp by `slip` (3,) a second."""
    if slip is None:
        ranges = cast(ROOM, se2.compose(pose, laser.mount.pose), laser.bearings_rad)[0]
    else:
        places = [se2.compose(pose + age * slip, laser.mount.pose) for age in laser.beam_offsets_s]
        each = zip(places, laser.bearings_rad, strict=True)
        ranges = np.array([cast(ROOM, at, np.array([bearing]))[0][0] for at, bearing in each])
    return ranges + bias_m + laser.sigma_range_m * rng.standard_normal(len(ranges))


def somewhere(rng):
    pose = np.array([rng.uniform(-2.5, -1.2), rng.uniform(-1.5, 2.0), rng.uniform(-3.1, 3.1)])
    return pose, pose + rng.standard_normal(3) * np.sqrt(np.diag(SPREAD))


def squared(fitted, pose):
    off = fitted.mean - pose
    off[2] = se2.wrap(off[2])
    return off @ np.linalg.solve(fitted.covariance, off)


def test_the_pose_is_that_of_scipy():
    """The pose and biases of maximum likelihood by the ranges themselves, cast again for each."""
    rng = np.random.default_rng(0)
    off = []
    for _ in range(10):
        pose, start = somewhere(rng)
        ranges = measured(pose, rng)

        def misses(x, start=start, ranges=ranges):
            expected = cast(ROOM, se2.compose(x[:3], LASER.mount.pose), LASER.bearings_rad)[0]
            expected = x[3] + (1.0 + x[4]) * expected
            prior = (x - [*start, 0.0, 0.0]) / [0.02, 0.02, 0.02, 0.01, 0.005]
            return np.concatenate([np.clip((ranges - expected) / 0.01, -4.0, 4.0), prior])

        found = least_squares(misses, [*pose, 0.0, 0.0], diff_step=1e-5).x
        fitted = fitter().fit(Gaussian(start, SPREAD), ranges, LASER.bearings_rad, STEADY)
        off.append((fitted.mean - found[:3]) / np.sqrt(np.diag(fitted.covariance)))
    assert np.median(np.abs(off)) < 0.2  # of its own standard deviation
    assert np.sqrt(np.mean(np.square(off))) < 1.0  # a beam at an edge counts for one, not the other


@pytest.mark.parametrize("planted", ["nothing", "bias", "sweep"])
def test_it_knows_its_error(planted):
    """Also with a laser that errs by 1 cm, or a robot that slips at random while it sweeps."""
    laser, slip_per_s = LASER, STEADY
    if planted == "sweep":
        laser = dataclasses.replace(LASER, n_beams=121, sweep_s=0.1)
        slip_per_s = np.diag([1e-3, 1e-6, 1e-3])
    rng = np.random.default_rng(1)
    squares = []
    for _ in range(60):
        pose, start = somewhere(rng)
        slip = None
        if planted == "sweep":  # a speed of the variance of a random walk's mean speed
            along, turn = rng.standard_normal(2) * np.sqrt(1e-3 / 0.1)
            slip = np.array([along * np.cos(pose[2]), along * np.sin(pose[2]), turn])
        bias_m = 0.01 if planted == "bias" else 0.0
        ranges = measured(pose, rng, laser, slip, bias_m)
        fitted = fitter(laser).fit(Gaussian(start, SPREAD), ranges, laser.bearings_rad, slip_per_s)
        squares.append(squared(fitted, pose))
    low, high = chi2.ppf([0.005, 0.995], 3 * len(squares)) / len(squares)
    assert (0.5 if planted == "sweep" else 0.8) * low < np.mean(squares) < 1.2 * high


def learns_what_another_does_not(learning, alone, most_m):
    """Beside a fitter that starts over, or forgets, of a laser that errs by 15 mm."""
    rng, found = np.random.default_rng(2), []
    for _ in range(20):
        pose, start = somewhere(rng)
        ranges, guess = measured(pose, rng, bias_m=0.015), Gaussian(start, SPREAD)
        learnt = learning.fit(guess, ranges, LASER.bearings_rad, STEADY)
        found.append([np.linalg.det(each.covariance) for each in (learnt, alone(guess, ranges))])
        assert np.hypot(*(learnt.mean - pose)[:2]) < most_m
    assert found[0][0] == found[0][1]
    assert found[-1][0] < 0.5 * found[-1][1]


def test_a_bias_is_learnt_from_scan_to_scan():
    def alone(guess, ranges):
        return fitter().fit(guess, ranges, LASER.bearings_rad, STEADY)

    learns_what_another_does_not(fitter(), alone, 0.01)


def test_a_bias_by_a_grid_is_learnt_only_where_told():
    grid = rasterize(MAP, 0.05, 0.2)
    forgetting = fitter(known_map=grid)

    def alone(guess, ranges):
        return forgetting.fit(guess, ranges, LASER.bearings_rad, STEADY, learn=False)

    learns_what_another_does_not(fitter(known_map=grid), alone, 0.03)


@pytest.mark.parametrize("exact", [True, False])
def test_scans_are_joined_where_walls_are_exact(exact):
    """By wheels that slip as little as a scan errs; what a grid errs by, scans have in common."""
    rng, slip_m = np.random.default_rng(6), 4e-4
    walls = MAP if exact else rasterize(MAP, 0.05, 0.2)
    joined, alone, squares = [], [], []
    for _ in range(8):
        made, (pose, start) = fitter(known_map=walls), somewhere(rng)
        guess = Gaussian(start, SPREAD)
        for _ in range(12):
            ranges = measured(pose, rng)
            first = made.fit(guess, ranges, LASER.bearings_rad, STEADY)
            second = fitter(known_map=walls).fit(guess, ranges, LASER.bearings_rad, STEADY)
            joined.append(first.mean - pose)
            alone.append(second.mean - pose)
            squares.append(squared(first, pose))
            motion = Gaussian(np.array([0.03, 0.0, 0.02]), slip_m**2 * np.eye(3))
            pose = se2.compose(pose, motion.mean + slip_m * rng.standard_normal(3))
            made.roll(motion)
            guess = Gaussian(se2.compose(guess.mean, motion.mean), SPREAD)
    ratio = np.sqrt(np.mean(np.square(joined), axis=0) / np.mean(np.square(alone), axis=0))[:2]
    assert (ratio.max() < 0.75) if exact else (ratio.min() > 0.95), ratio
    assert np.mean(squares) / 3.0 < 1.3


def test_where_wheels_mislead_a_scan_counts_alone():
    rng = np.random.default_rng(7)
    made, (pose, start) = fitter(), somewhere(rng)
    made.fit(Gaussian(start, SPREAD), measured(pose, rng), LASER.bearings_rad, STEADY)
    made.roll(Gaussian(np.zeros(3), 1e-8 * np.eye(3)))  # so they say
    pose = pose + np.array([0.03, 0.0, 0.01])
    found = made.fit(Gaussian(start, SPREAD), measured(pose, rng), LASER.bearings_rad, STEADY)
    assert np.hypot(*(found.mean - pose)[:2]) < 0.005


def test_people_do_not_count():
    rng = np.random.default_rng(3)
    pose, start = somewhere(rng)
    ranges = measured(pose, rng)
    short = rng.random(len(ranges)) < 0.4
    ranges[short] *= rng.uniform(0.2, 0.9, int(short.sum()))
    fitted = fitter().fit(Gaussian(start, SPREAD), ranges, LASER.bearings_rad, STEADY)
    assert np.hypot(*(fitted.mean - pose)[:2]) < 0.005
    assert abs(fitted.mean[2] - pose[2]) < 0.002


def test_what_does_not_fit_is_none():
    rng = np.random.default_rng(4)
    pose, _ = somewhere(rng)
    ranges, guess = measured(pose, rng), Gaussian(pose, SPREAD)
    bearings = LASER.bearings_rad
    assert fitter().fit(guess, ranges, bearings, STEADY) is not None
    assert fitter().fit(guess, 0.3 * ranges, bearings, STEADY) is None  # few ends at walls
    assert fitter().fit(guess, np.full(len(ranges), np.inf), bearings, STEADY) is None
    sure_elsewhere = Gaussian(pose + np.array([0.08, 0.0, 0.0]), 1e-6 * np.eye(3))
    assert fitter().fit(sure_elsewhere, ranges, bearings, STEADY) is None


def test_a_grid_is_known_to_err_by_its_cells():
    rng = np.random.default_rng(5)
    grid = rasterize(MAP, 0.05, 0.2)
    squares, off_m = [], []
    for _ in range(40):
        pose, start = somewhere(rng)
        ranges, made = measured(pose, rng), fitter(known_map=grid)
        fitted = made.fit(Gaussian(start, SPREAD), ranges, LASER.bearings_rad, STEADY)
        squares.append(squared(fitted, pose))
        off_m.append(np.hypot(*(fitted.mean - pose)[:2]))
    assert np.mean(squares) / 3.0 < 1.5
    assert np.sqrt(np.mean(np.square(off_m))) < 0.012
