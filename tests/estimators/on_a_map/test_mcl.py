"""Monte Carlo localization: tracking, finding, being carried off, and knowing its error."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.stats import chi2

from estimators.base import Prior, run
from estimators.gaussian import wheel_motion
from estimators.on_a_map.mcl import Mcl, amcl_alphas
from experiments.evaluation.metrics import nees
from experiments.gate.conform import check_estimator
from sim import se2
from sim.errors import InputError
from sim.robot.drive import RobotGeometry
from sim.robot.slip import wheel_variances
from sim.worlds.world import World
from tests.estimators.laser.test_icp import ROOM
from tests.estimators.laser.test_icp_odometry import LASER, P0, START, TRACK_M, drive
from tests.fixtures.fakes import blind, circle, tracking_prior, with_scan

MAP = World("room", ROOM, np.tile([0.0, 2.0], (len(ROOM), 1)))
NOISE_M = 0.002  # of the wheels, each frame
WHEELS = {"kr": 1e-4, "kl": 1e-4}


def prior(start=True, laser=LASER):
    sensors = {} if laser is None else {"laser": laser}
    robot = RobotGeometry(0.05, TRACK_M)
    return Prior(robot, sensors, START.copy() if start else None, P0 if start else None, MAP)


def follow(estimator, frames, given, seed=0):
    estimator.reset(given, np.random.default_rng(seed))
    return [estimator.step(frame) for frame in frames]


def errors(beliefs, poses):
    off = np.array([b.mean for b in beliefs]) - poses
    return np.hypot(off[:, 0], off[:, 1]), np.abs(se2.wrap(off[:, 2]))


def test_tracks():
    poses, frames = drive(ROOM, 100, wheel_noise_m=NOISE_M)
    beliefs = follow(Mcl(max_particles=3000, **WHEELS), frames, prior())
    off_m, off_rad = errors(beliefs, poses)
    assert off_m.max() < 0.1
    assert off_rad.max() < 0.05
    counts = [len(b.extras["particles"]) for b in beliefs]
    assert counts[0] == 3000
    assert counts[-1] == 1000  # so small a belief needs no more
    assert beliefs[-1].extras["hypothesis_weight"] > 0.99
    used = np.unique([id(b.extras["particles"]) for b in beliefs])
    assert 20 <= len(used) <= 30  # a scan every 0.2 m of 5 m


def test_says_that_it_is_lost():
    _, frames = drive(ROOM, 60, wheel_noise_m=NOISE_M)
    given = prior()
    astray = dataclasses.replace(given, mean=given.mean + np.array([1.0, -1.0, 1.0]))
    here, there = (follow(Mcl(**WHEELS, recovery="none"), frames, g) for g in (given, astray))
    assert max(belief.extras["lost"] for belief in here) < 0.2
    assert min(belief.extras["lost"] for belief in there[1:]) > 0.4


def test_a_scan_that_is_not_used_tells_of_wheels_that_stand():
    _, frames = drive(ROOM, 60, wheel_noise_m=NOISE_M)
    still = [dataclasses.replace(f, wheel_increments_m=np.zeros(2)) for f in frames[30:]]
    lifted = [*frames[:30], *still]
    beliefs = follow(Mcl(**WHEELS, recovery="none"), lifted, prior())
    said = [belief.extras["lost"] for belief in beliefs]
    assert beliefs[29].extras["particles"] is beliefs[-1].extras["particles"]  # none is used
    assert max(said[:30]) < 0.2
    assert said[-1] > 0.4


@pytest.mark.slow
def test_knows_its_error():
    """With likelihoods at their worth and no jitter, over recordings, and scans of 60 beams."""
    squares = []
    for seed in range(20):
        recording = circle(seed, n_frames=60, kr=1e-4, kl=1e-4)
        given = tracking_prior(recording, sigma=(0.05, 0.05, 0.03))
        rng = np.random.default_rng([seed, 1])
        start = rng.multivariate_normal(given.mean, given.covariance)
        sharp = Mcl(
            min_particles=3000, max_particles=3000, beam_power=1.0, min_ess=0.0,
            sigma_m=0.05, cell_m=0.02, jitter_m=0.0, jitter_rad=0.0, **WHEELS,
        )  # fmt: skip
        online = run(sharp, recording, dataclasses.replace(given, mean=start), rng)
        squares.append(nees(recording.truth.poses, online.means, online.covariances)[[29, 59]])
    assert 0.45 < np.mean(squares) / 3.0 < 1.3  # 40 runs: 0.67


def test_finds_the_robot_anywhere():
    found = 0
    for seed in range(6):
        poses, frames = drive(ROOM, 80, wheel_noise_m=NOISE_M, seed=seed)
        beliefs = follow(Mcl(max_particles=4000, **WHEELS), frames, prior(start=False), seed)
        off_m, off_rad = errors(beliefs, poses)
        found += off_m[40:].max() < 0.2 and off_rad[40:].max() < 0.1
        assert beliefs[0].covariance[0, 0] > 0.01  # and does not claim it from the start
    assert found >= 5


@pytest.mark.parametrize("recovery", ["average", "rivals", "none"])
def test_carried_off(recovery):
    """Set down elsewhere at frame 40: found again with recovery on, lost for good without."""
    poses, frames = drive(ROOM, 40, wheel_noise_m=NOISE_M)
    after, more = drive(ROOM, 100, start=[3.8, 3.0, START[2] + math.pi], wheel_noise_m=NOISE_M)
    poses = np.concatenate([poses, after[1:]])
    frames += [dataclasses.replace(frame, stamp=frame.stamp + 4.0) for frame in more[1:]]
    estimator = Mcl(max_particles=4000, recovery=recovery, rival_scans=5, **WHEELS)
    beliefs = follow(estimator, frames, prior())
    off_m = errors(beliefs, poses)[0]
    assert off_m[:40].max() < 0.15
    if recovery != "none":
        assert off_m[-30:].max() < 0.2
        assert max(b.extras["injected"] for b in beliefs[40:]) > 0
        assert max(b.extras["injected"] for b in beliefs[:40]) == 0
    else:
        assert off_m[40:].min() > 0.5


def test_people_before_the_laser_are_not_being_lost():
    """Half the beams end short for three metres: the average calls that lost, rivals do not."""
    poses, frames = drive(ROOM, 120, wheel_noise_m=NOISE_M)
    rng = np.random.default_rng(1)
    for i in range(40, 100):
        ranges = frames[i].readings["laser"]["ranges_m"].copy()
        short = rng.random(len(ranges)) < 0.5
        ranges[short] *= rng.uniform(0.2, 0.9, int(short.sum()))
        frames[i] = with_scan(frames[i], ranges)
    injected = {}
    for recovery in ("average", "rivals"):
        beliefs = follow(Mcl(max_particles=4000, recovery=recovery, **WHEELS), frames, prior())
        injected[recovery] = max(b.extras["injected"] for b in beliefs)
        if recovery == "rivals":
            assert errors(beliefs, poses)[0].max() < 0.1
    assert injected["average"] > 0
    assert injected["rivals"] == 0


def test_people_cost_no_more_than_bounded_losses_let_them():
    """A third of the beams a little short, as at legs before walls: the bound keeps the error."""
    poses, frames = drive(ROOM, 100, wheel_noise_m=NOISE_M)
    rng = np.random.default_rng(2)
    for i, frame in enumerate(frames):
        ranges = frame.readings["laser"]["ranges_m"].copy()
        short = rng.random(len(ranges)) < 1.0 / 3.0
        ranges[short] -= rng.uniform(0.1, 0.6, int(short.sum()))
        frames[i] = with_scan(frame, ranges)
    rms = {}
    for max_loss in (2.0, 7.0):
        estimator = Mcl(max_particles=2000, max_loss=max_loss, fit_walls=False, **WHEELS)
        beliefs = follow(estimator, frames, prior())
        rms[max_loss] = float(np.sqrt(np.mean(np.square(errors(beliefs, poses)[0]))))
    assert rms[2.0] < 0.06
    assert rms[7.0] > 1.3 * rms[2.0], rms


def test_number_of_particles_follows_fox():
    """n is the quantile of chi-square with k - 1 degrees of freedom over twice the error."""
    estimator = Mcl(kld_error=0.02, kld_quantile=2.3263, bin_m=0.5)
    estimator.reset(prior(), np.random.default_rng(0))
    for k in (2, 10, 100):
        poses = np.zeros((2 * k, 3))
        poses[:, 0] = -3.0 + 0.5 * (np.arange(2 * k) // 2 % 14) + 0.25
        poses[:, 2] = -3.0 + 0.17 * (np.arange(2 * k) // 2 // 14)
        assert estimator._bins.count_particles(poses) == pytest.approx(
            chi2.ppf(0.99, k - 1) / (2 * 0.02), rel=0.03 if k > 2 else 0.2
        )
    assert estimator._bins.count_particles(np.zeros((9, 3))) == 1


def test_a_scan_is_not_counted_beyond_what_the_particles_bear():
    _, frames = drive(ROOM, 1)
    estimator = Mcl(max_particles=4000, min_particles=4000, beam_power=1.0, min_ess=0.25, tries=1)
    wide = dataclasses.replace(prior(), covariance=np.diag([1.0, 1.0, 0.5]))
    belief = follow(estimator, frames, wide)[0]
    assert belief.extras["ess"] == pytest.approx(1000.0, rel=0.05)
    free = Mcl(max_particles=4000, min_particles=4000, beam_power=1.0, min_ess=0.0, tries=1)
    assert follow(free, frames, wide)[0].extras["ess"] < 100.0


def test_mapping_to_amcl():
    """Variances of the wheels' slip on a straight and in a turn are those that AMCL would draw."""
    kr, kl, distance_m, turn_rad = 2e-4, 1e-4, 0.25, 0.4
    a1, a2, a3, a4 = amcl_alphas(kr, kl, TRACK_M, distance_m, turn_rad)

    def spread(travel):
        return wheel_motion(travel, wheel_variances(travel, kr, kl), TRACK_M)[0].covariance

    straight = spread(np.array([distance_m, distance_m]))
    assert straight[0, 0] == pytest.approx(a3 * distance_m**2)
    assert straight[2, 2] == pytest.approx(2.0 * a2 * distance_m**2)
    half = turn_rad * TRACK_M / 2.0
    turned = spread(np.array([half, -half]))
    assert turned[2, 2] == pytest.approx(a1 * turn_rad**2)
    cos, sin = math.cos(turn_rad / 2), math.sin(turn_rad / 2)
    along = np.array([cos, sin])
    sinc = math.sin(turn_rad / 2) / (turn_rad / 2)
    assert along @ turned[:2, :2] @ along == pytest.approx(a4 * turn_rad**2 * sinc**2)


def test_scans_without_returns_and_none():
    poses, frames = drive(ROOM, 60, wheel_noise_m=NOISE_M)
    empty = np.full(LASER.n_beams, np.inf)
    frames[20:30] = [with_scan(f, empty) for f in frames[20:30]]
    frames[40:50] = [blind(f) for f in frames[40:50]]
    beliefs = follow(Mcl(max_particles=2000, **WHEELS), frames, prior())
    told = [i for i, b in enumerate(beliefs) if "status" in b.extras]
    assert told
    assert set(told) <= set(range(20, 30))
    assert beliefs[told[0]].extras["status"] == "scan without returns"
    assert errors(beliefs, poses)[0].max() < 0.15
    traces = [np.trace(b.covariance) for b in beliefs]
    assert traces[49] > traces[40]


def test_beliefs_stay_as_they_were_told():
    _, frames = drive(ROOM, 30)
    estimator = Mcl(
        min_particles=500, max_particles=500, ess_share=0.01, min_ess=0.0
    )  # never resampled
    estimator.reset(prior(), np.random.default_rng(0))
    first = estimator.step(frames[0])
    kept = first.extras["particles"].copy()
    for frame in frames[1:]:
        estimator.step(frame)
    np.testing.assert_array_equal(first.extras["particles"], kept)


def test_one_particle():
    _, frames = drive(ROOM, 20)
    beliefs = follow(Mcl(min_particles=1, max_particles=1, tries=1), frames, prior())
    assert np.isfinite(beliefs[-1].mean).all()


@pytest.mark.slow
def test_conforms():
    recording = circle(3, n_frames=40)
    checks = check_estimator(lambda: Mcl(max_particles=1000), recording, tracking_prior(recording))
    for check in checks:
        assert check.passed, f"{check.name}: {check.message}"


def test_wrong_input_is_named():
    rng = np.random.default_rng(0)
    with pytest.raises(InputError, match="laser"):
        Mcl().reset(prior(laser=None), rng)
    with pytest.raises(InputError, match="map"):
        Mcl().reset(dataclasses.replace(prior(), map=None), rng)
    for options, word in (
        ({"min_particles": 100, "max_particles": 50}, "min_particles"),
        ({"min_ess": 0.5, "ess_share": 0.5}, "ess_share"),
        ({"max_particles": 10**12}, "max_particles must be a whole number from 1 to 10000000"),
        ({"max_particles": 10**6, "tries": 10**12}, "tries"),
    ):
        with pytest.raises(InputError, match=word):
            Mcl(**options)
    for options in ({"bin_m": 1e-4}, {"bin_m": 1e-9}, {"bin_m": 5e-324}, {"bin_rad": 1e-300}):
        with pytest.raises(
            InputError, match=f"estimator.*{next(iter(options))}=.* bins of the map"
        ):
            Mcl(max_particles=1000, **options).reset(prior(), rng)


def test_the_fit_is_the_better_answer_and_leaves_the_particles_alone():
    poses, frames = drive(ROOM, 100, wheel_noise_m=NOISE_M)
    told = {}
    for fitted in (True, False):
        estimator = Mcl(max_particles=2000, fit_walls=fitted, **WHEELS)
        told[fitted] = follow(estimator, frames, prior())
    for with_fit, without in zip(told[True], told[False], strict=True):
        np.testing.assert_array_equal(with_fit.extras["particles"], without.extras["particles"])
    for by_fit, by_particles in zip(
        errors(told[True], poses), errors(told[False], poses), strict=True
    ):
        assert 3.0 * np.sqrt(np.mean(by_fit**2)) < np.sqrt(np.mean(by_particles**2))
