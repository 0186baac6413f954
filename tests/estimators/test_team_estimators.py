"""Estimators of teams: a team of one, sightings, starts, communication, consistency."""

import dataclasses
import functools

import numpy as np
import pytest
from scipy import stats

from estimators.base import Belief, Prior, run
from estimators.graph.camera_residuals import PoseSightings
from estimators.graph.smoother import Smoother
from estimators.landmarks.ekf_slam import EkfSlam
from estimators.landmarks.fastslam import FastSLAM
from estimators.landmarks.sightings import Sightings, pose_by_points
from estimators.landmarks.stereo import StereoModel
from estimators.team import Communication, run_team
from estimators.wheels import WheelPrediction
from experiments.evaluation.metrics import nees
from experiments.runs.evaluate import in_range
from experiments.runs.experiment import Experiment
from sim import se2
from sim.errors import InputError
from sim.recording import Log
from sim.sensors import Mount, RobotCamera
from sim.sensors.base import View
from sim.sensors.stereo import points_in_camera
from sim.team import Team
from tests.fixtures.fakes import circle, tracking_prior, true_ids

WHEELS = {"kr": 1e-4, "kl": 1e-4}
SEEING = {"robots": "robots", **WHEELS}
EYE = RobotCamera(rate_hz=5.0, fov_horizontal_rad=2.0)
STARTS = ((0.5, -1.0, 0.4), (-1.0, -1.5, 0.9), (2.0, 0.5, 2.6))
SIGMA = (0.02, 0.02, 0.01)


class Open:
    """Rays without walls."""

    def sees(self, origin, points):
        return np.ones(len(points), bool)


def sharper(recording):
    """The recording with images of less noise, so that an EKF's linearisation holds."""
    camera = dataclasses.replace(
        recording.sensors["stereo"],
        sigma_column_px=0.3,
        sigma_row_px=0.3,
        sigma_disparity_px=0.1,
    )
    log, world = recording.logs["stereo"], recording.truth.world
    poses = np.repeat(recording.truth_at(log.stamps), np.diff(log.splits), axis=0)
    points = [
        points_in_camera(camera, pose, world.landmarks[[i]])[0]
        for pose, i in zip(poses, true_ids(recording), strict=True)
    ]
    seen = camera.measure(np.array(points), np.random.default_rng(recording.config["seed"]))
    log = dataclasses.replace(log, values={**log.values, "points_in_camera": seen})
    return recording.with_log("stereo", log, camera)


def fake_team(seed, n_robots=2, n_frames=40, sensor=EYE):
    """Robots on circles in one room, which see each other; without the simulator."""
    made = [
        circle(100 * seed + k, n_frames=n_frames, start=start, kr=1e-4, kl=1e-4).without("laser")
        for k, start in enumerate(STARTS[:n_robots])
    ]
    seen = []
    for k, recording in enumerate(map(sharper, made)):
        probe = sensor.start(np.random.default_rng([seed, k]))
        stamps = recording.logs["stereo"].stamps
        at = [other.truth_at(stamps) for other in made]
        readings = [
            probe(View(t, at[k][i], None, Open(), t, at[k][i], others))
            for i, t in enumerate(stamps)
            for others in [{j: at[j][i] for j in range(n_robots) if j != k}]
        ]
        points = np.concatenate([reading["points_in_camera"] for reading in readings])
        numbers = np.concatenate([reading["true_ids"] for reading in readings])
        shown = {"ids": numbers} if sensor.identifies else {}
        splits = np.cumsum([0, *(len(reading["true_ids"]) for reading in readings)])
        log = Log.of(sensor, stamps, splits, points_in_camera=points, **shown)
        recording = recording.with_log("robots", log, sensor)
        hidden = {**recording.truth.readings, "robots": {"true_ids": numbers}}
        truth = dataclasses.replace(recording.truth, readings=hidden)
        seen.append(dataclasses.replace(recording, truth=truth))
    return Team.on_one_clock(seen)


def priors_of(team, seed=0, sigma=SIGMA, known=None):
    """Priors drawn about the true starts; only the first `known` robots have one."""
    rng, priors = np.random.default_rng(seed), []
    for k, recording in enumerate(team.robots):
        prior = tracking_prior(recording, sigma, with_map=False)
        off = np.asarray(sigma) * rng.standard_normal(3)
        mean = prior.mean + off if known is None or k < known else None
        covariance = prior.covariance if mean is not None else None
        priors.append(dataclasses.replace(prior, mean=mean, covariance=covariance))
    return priors


def answers(make, team, priors, communication=None, contacts=None):
    return run_team(make, team, priors, lambda k: np.random.default_rng(k), communication, contacts)


def same(first, second):
    return np.array_equal(first.means, second.means, equal_nan=True) and np.array_equal(
        first.covariances, second.covariances, equal_nan=True
    )


@pytest.mark.parametrize(
    "make",
    [
        lambda robots: EkfSlam(robots=robots, **WHEELS),
        lambda robots: FastSLAM(n_particles=20, robots=robots, **WHEELS),
        lambda robots: Smoother(robots=robots, **WHEELS),
    ],
)
def test_a_team_of_one_is_the_robot_alone(make):
    team = fake_team(0, n_robots=1, n_frames=30)
    priors, recording = priors_of(team), team.robots[0]
    [(online, revised)] = answers(lambda: make("robots"), team, priors)
    alone = make(None)
    assert same(online, run(alone, recording, priors[0], np.random.default_rng(0)))
    if revised is not None:
        assert same(revised, alone.finish())


def test_derivatives_of_sightings():
    eye = dataclasses.replace(EYE, mount=Mount(x_m=0.2, y_m=-0.1, z_m=0.4, yaw_rad=0.3))
    sightings = Sightings.of([Prior(None, {"robots": eye})], "robots", "test")
    pose, other = np.array([0.3, -0.2, 0.7]), np.array([3.0, 2.5, -1.0])
    _, *by = sightings.predict(pose, other)
    residuals = PoseSightings(sightings, np.array([0]), np.array([1]), np.ones((1, 3)))
    both = np.array([pose, other])
    _, *whitened = residuals.residuals(both, True)
    for side in (0, 1):
        for axis in range(3):
            step = np.zeros((2, 3))
            step[side, axis] = 1e-6
            moved = [sightings.predict(*(both + s * step))[0] for s in (1, -1)]
            np.testing.assert_allclose(by[side][:, axis], (moved[0] - moved[1]) / 2e-6, atol=1e-7)
            moved = [residuals.residuals(both + s * step, True)[0][0] for s in (1, -1)]
            slope = (moved[0] - moved[1]) / 2e-6
            np.testing.assert_allclose(whitened[side][0, :, axis], slope, atol=1e-5)


def final_nees(make, seeds, which, **options):
    """NEES of all robots at the end, over draws of noise and starts."""
    found = []
    for seed in seeds:
        team = fake_team(seed, **{k: v for k, v in options.items() if k == "n_robots"})
        priors = priors_of(team, seed, known=options.get("known"))
        for recording, answer in zip(team.robots, answers(make, team, priors), strict=True):
            estimate = answer[which]
            truth = recording.truth_at(estimate.stamps)[-1:]
            found.append(nees(truth, estimate.means[-1:], estimate.covariances[-1:]))
    return np.concatenate(found)


@pytest.mark.parametrize("known", [None, pytest.param(1, marks=pytest.mark.slow)])
def test_the_team_is_as_sure_as_it_errs(known):
    """NEES of the EKF in its 99.9 % band, with known starts and with unknown ones."""
    found = final_nees(lambda: EkfSlam(**SEEING), range(12), 0, known=known)
    assert np.isfinite(found).all()
    low, high = stats.chi2.ppf([0.0005, 0.9995], 3 * 12) / 12  # robots of a map err together
    assert low < found.mean() < high
    believed = {"kr": 1e-6, "kl": 1e-6, "errors": "coordinates"}
    bold = final_nees(lambda: EkfSlam(robots="robots", **believed), range(4), 0, known=known)
    assert bold.mean() > high  # a filter that believes too little slip is found out


@pytest.mark.slow
def test_the_batch_of_a_team_is_as_sure_as_it_errs():
    found = final_nees(lambda: Smoother(**SEEING), range(6), 1)
    low, high = stats.chi2.ppf([0.0005, 0.9995], 3 * len(found)) / len(found)
    assert low < found.mean() < high


def test_sightings_inform_both_robots():
    team = fake_team(1, n_frames=30)
    priors = priors_of(team, 1)
    for kind, which in ((EkfSlam, 0), (Smoother, 1)):
        without = answers(functools.partial(kind, **WHEELS), team, priors)
        seeing = answers(functools.partial(kind, **SEEING), team, priors)
        for with_, bare in zip(seeing, without, strict=True):
            determinants = [np.linalg.det(each[which].covariances[-1]) for each in (with_, bare)]
            assert determinants[0] < 0.99 * determinants[1]


def test_particles_are_weighed_by_the_gaussian_of_the_pixels():
    team = fake_team(2, n_frames=1)
    filters = [FastSLAM(n_particles=40, robots=name, **WHEELS) for name in ("robots", None)]
    [frames] = team.instants()
    number = next(k for k in (0, 1) if len(frames[k].readings["robots"]["ids"]))
    beliefs = []
    for each in filters:
        each.reset_team(priors_of(team, sigma=(0.1, 0.1, 0.05)), np.random.default_rng(0))
        beliefs.append(each.step_team(frames))
    gained = np.subtract(*(b[0].extras["log_weights"] for b in beliefs))
    poses = [belief.extras["particles"] for belief in beliefs[0]]
    [point], camera = frames[number].readings["robots"]["points_in_camera"], EYE.camera
    model = StereoModel.of(camera)
    wanted = np.zeros(40)
    for m, (own, other) in enumerate(zip(poses[number], poses[1 - number], strict=True)):
        predicted = model.predict(own, np.array([*other[:2], EYE.marker_z_m]))[0]
        off = (model.to_image(point) - model.to_image(predicted)) / np.sqrt(model.variances_px2)
        wanted[m] = -0.5 * off @ off
    if len(frames[1 - number].readings["robots"]["ids"]) == 0:
        np.testing.assert_allclose(gained - gained[0], wanted - wanted[0], rtol=1e-6, atol=1e-6)
    else:
        pytest.fail("this instant must have one sighting")


def test_a_misread_robot_is_rejected():
    team = fake_team(3, n_robots=3, n_frames=40)
    log = team.robots[0].logs["robots"]
    wrong = log["ids"].copy()
    wrong[-1] = 3 - wrong[-1]
    values = {**log.values, "ids": wrong}
    misread = team.robots[0].with_log("robots", dataclasses.replace(log, values=values))
    dropped = np.arange(len(wrong)) < len(wrong) - 1
    less = dataclasses.replace(
        log,
        values={key: value[dropped] for key, value in log.values.items()},
        splits=np.minimum(log.splits, len(wrong) - 1),
    )
    without = team.robots[0].with_log("robots", less)
    for make in (lambda: EkfSlam(**SEEING), lambda: FastSLAM(n_particles=30, **SEEING)):
        found = [
            answers(make, Team((robot, *team.robots[1:])), priors_of(team))
            for robot in (misread, without)
        ]
        assert same(found[0][1][0], found[1][1][0])


def test_sightings_without_ids_go_to_the_nearest_robot():
    nameless = dataclasses.replace(EYE, identifies=False)
    found = []
    for sensor in (EYE, nameless):
        team = fake_team(4, n_robots=3, n_frames=30, sensor=sensor)
        found.append(answers(lambda: EkfSlam(**SEEING), team, priors_of(team)))
    for first, second in zip(*found, strict=True):
        assert same(first[0], second[0])
    with pytest.raises(InputError, match=r"sightings without ids; set sensors.robots.identifies"):
        answers(lambda: FastSLAM(n_particles=5, **SEEING), team, priors_of(team))


def test_a_robot_of_unknown_start_is_placed_by_what_it_sees():
    team = fake_team(5)
    [(_, _), (online, _)] = answers(lambda: EkfSlam(**SEEING), team, priors_of(team, known=1))
    placed = np.isfinite(online.means).all(axis=1)
    assert placed.any()
    off = se2.difference(online.means[placed], team.robots[1].truth_at(online.stamps[placed]))
    assert np.hypot(*off[-1, :2]) < 0.3
    with pytest.raises(InputError, match="fastslam needs the starts of all robots"):
        answers(lambda: FastSLAM(**SEEING), team, priors_of(team, known=1))


def test_pose_by_points():
    rng = np.random.default_rng(0)
    pose, points = np.array([1.0, -2.0, 2.5]), rng.uniform(-4, 4, (5, 2))
    np.testing.assert_allclose(pose_by_points(points, se2.transform(pose, points)), pose)
    assert pose_by_points(points[:1], points[:1]) is None
    assert pose_by_points(0.1 * points, points) is None


class Listener:
    """An estimator that notes each Frame it is given."""

    def __init__(self):
        self.heard = []

    def reset_team(self, priors, rng):
        self.n = len(priors)

    def step_team(self, frames):
        self.heard += [(frame.robot, frame.stamp) for frame in frames]
        return [Belief(np.zeros(3), np.eye(3)) for _ in frames]


def test_what_comes_back_by_way_of_others_is_not_counted_twice():
    """Frames that go round among robots reach each filter once; all of them when all meet."""
    team = fake_team(6, n_robots=3, n_frames=20)
    n = len(list(team.instants()))
    contacts = np.zeros((n, 3, 3), bool)
    for i in range(n):
        a, b = [(0, 1), (1, 2), (2, 0), (1, 1)][i % 4]
        contacts[i, a, b] = contacts[i, b, a] = True
    contacts[-1] = True
    made = []

    def make():
        made.append(Listener())
        return made[-1]

    answers(make, team, priors_of(team), Communication(kind="range", range_m=1.0), contacts)
    every = sorted((k, t) for k in range(3) for t in team.robots[k].frame_stamps)
    for listener in made:
        assert sorted(listener.heard) == every


def test_a_robot_gains_nothing_from_itself():
    """What it told another, who saw nothing, comes back: its belief is that of the robot alone."""
    team = fake_team(8, n_frames=30)
    own, other = team.robots
    unseen = own.without("robots"), other.without("stereo").without("robots")
    pair = Team(tuple(dataclasses.replace(each, sensors=own.sensors) for each in unseen))
    priors = priors_of(team)
    contacts = np.ones((len(own.frame_stamps), 2, 2), bool)
    talk = Communication(kind="range", range_m=9.0)
    [(found, _), _] = answers(lambda: EkfSlam(**SEEING), pair, priors, talk, contacts)
    alone = run(EkfSlam(**WHEELS), own, priors[0], np.random.default_rng(0))
    np.testing.assert_allclose(found.covariances, alone.covariances, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(found.means, alone.means, atol=1e-9)
    # that the same images counted twice would show, in the classical filter most
    classical = EkfSlam(**WHEELS, errors="coordinates")
    alone = run(classical, own, priors[0], np.random.default_rng(0))
    twice = EkfSlam(**SEEING, errors="coordinates")
    twice.reset_team([priors[0]], np.random.default_rng(0))
    for frame in own.without("robots").frames():
        again = dataclasses.replace(frame, wheel_increments_m=np.zeros(2), duration_s=0.0)
        beliefs = [twice.step_team([each])[0] for each in (frame, again)]
    determinants = [np.linalg.det(c) for c in (beliefs[-1].covariance, alone.covariances[-1])]
    assert determinants[0] < 0.95 * determinants[1]


def test_kinds_of_communication():
    team = fake_team(7, n_frames=30)
    priors, n = priors_of(team), len(team.robots[0].frame_stamps)
    make = lambda: EkfSlam(**SEEING)  # noqa: E731
    always = answers(make, team, priors)
    together = np.ones((n, 2, 2), bool)
    near = answers(make, team, priors, Communication(kind="range", range_m=9.0), together)
    never = answers(make, team, priors, Communication(kind="never"))
    apart = answers(make, team, priors, Communication(kind="range", range_m=9.0), ~together)
    late = answers(make, team, priors, Communication(kind="delayed", delay_s=0.55))
    for k, recording in enumerate(team.robots):
        alone = run(EkfSlam(**WHEELS), recording, priors[k], np.random.default_rng(0))
        assert same(near[k][0], always[k][0])
        assert same(never[k][0], alone)
        # without contact the others stand where they were, and no sighting is used
        np.testing.assert_allclose(apart[k][0].means, alone.means, atol=1e-9)
        determinants = [np.linalg.det(each[k][0].covariances[-1]) for each in (always, late)]
        assert determinants[0] < determinants[1]
    # the answer of six Frames ago, carried on by the wheels
    estimator = EkfSlam(**SEEING)
    wheels = WheelPrediction(estimator, team.robots[0].robot.track_m)
    belief = None
    for i, frame in enumerate(team.robots[0].frames()):
        motion = wheels.predict(frame)
        if i == n - 7:
            belief = type(motion)(always[0][0].means[i], always[0][0].covariances[i])
        elif belief is not None:
            belief = belief.then(motion)
    np.testing.assert_allclose(late[0][0].means[-1], belief.mean)
    np.testing.assert_allclose(late[0][0].covariances[-1], belief.covariance)


def test_communication_refuses_what_has_no_effect():
    with pytest.raises(InputError, match=r"communication.range_m must be a positive number"):
        Communication(kind="range")
    with pytest.raises(InputError, match=r"communication.delay_s has no effect on kind=always"):
        Communication(kind="always", delay_s=1.0)
    with pytest.raises(InputError, match="kind"):
        Communication(kind="sometimes")


def test_robots_of_a_team_carry_the_same_sensors():
    team = fake_team(0, n_frames=5)
    priors = priors_of(team)
    other = {**priors[1].sensors, "robots": dataclasses.replace(EYE, rate_hz=2.0)}
    with pytest.raises(InputError, match="robot 1 has other sensors than robot 0"):
        EkfSlam().reset_team([priors[0], dataclasses.replace(priors[1], sensors=other)], None)
    bare = {k: v for k, v in priors[0].sensors.items() if k != "robots"}
    with pytest.raises(InputError, match=r"estimator.robots: no sensor named robots"):
        EkfSlam(**SEEING).reset_team([dataclasses.replace(priors[0], sensors=bare)], None)


def test_repeats_are_counted_for_each_robot():
    """What another robot saw is news, however lately."""
    team = fake_team(0, n_robots=1, n_frames=2)
    [prior], frames = priors_of(team), [*team.robots[0].frames()]
    filter_ = EkfSlam(repeat_s=1e3, **WHEELS)
    filter_.reset_team([prior, prior], np.random.default_rng(0))
    used = []
    for frame in (frames[0], dataclasses.replace(frames[0], robot=1), frames[0]):
        [belief] = filter_.step_team([frame])
        used.append(np.count_nonzero(belief.extras["associations"] >= 0))
    assert used[0] == used[1] > 0 == used[2]


def test_in_range():
    team = fake_team(0, n_frames=10)
    near = in_range(team, 3.0)
    at = [robot.truth.poses[:, :2] for robot in team.robots]
    assert near.shape == (10, 2, 2)
    assert np.array_equal(near[:, 0, 1], np.hypot(*(at[0] - at[1]).T) <= 3.0)


@pytest.mark.parametrize(
    ("overrides", "complaint"),
    [
        (["team.size=6"], "team.size must be from 1 to the 5 of team.robots"),
        (["team.starts=guessed"], "team.starts must be one of known, unknown"),
        (["+team.colour=red"], "unknown key team; known: world"),
        (["team.robots=[{wheels: 3}]", "team.size=1"], r"unknown key team.robots\[0\].wheels"),
        (["team.robots=[{route: {speed: 3}}]", "team.size=1"], r"robots\[0\].route.speed"),
        (["team.communication.kind=range"], "communication.range_m must be a positive number"),
    ],
)
def test_wrong_teams_are_refused(overrides, complaint):
    with pytest.raises(InputError, match=complaint):
        Experiment.compose(["study=teams", *overrides]).check()


def test_first_robots_of_a_simulated_team():
    short = ["study=teams", "route.distance_m=2", "world.n_landmarks=10", "team.size=3"]
    wide = ["sensors.robots.fov_horizontal_rad=3.1", "sensors.robots.max_distance_m=30"]
    team = Experiment.compose([*short, *wide]).simulate_team()
    two = team.first(2)
    assert len(two) == 2
    assert set(np.concatenate([r.logs["robots"]["ids"] for r in two.robots])) <= {0, 1}
    alone = Experiment.compose([*short, *wide]).of_robot(0).simulate()
    one = team.first(1).robots[0]
    assert np.array_equal(one.truth.poses, alone.truth.poses)
    assert np.array_equal(one.wheels.position_m, alone.wheels.position_m)
