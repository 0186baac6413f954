"""Which rows get a bound, what it is not for, and that a cheat lies below it."""

import dataclasses

import numpy as np
import pytest

import experiments.evaluation.recording_bound as bounds
from estimators.base import Belief
from experiments.evaluation.statistics import over_bound
from experiments.runs.evaluate import evaluate
from experiments.runs.experiment import Experiment
from sim.recording import Recording
from sim.sensors.stereo import points_in_camera
from tests.fixtures.derivatives import slope

DRIVE = (
    "robot=robocom",
    "world=rooms",
    "simulation.physics=kinematic",
    "simulation.rays=exact",
)
SHORT = (*DRIVE, "route.distance_m=4")
STEREO, LASER = (*SHORT, "sensors=stereo_pixel"), (*SHORT, "sensors=hokuyo")
COLUMNS = {"bound_rmse_m", "bound_heading_rad"}


class Cheat:
    """The truth with a little noise."""

    def __init__(self, recording: Recording, sigma: float) -> None:
        self.truth, self.sigma = recording.truth_at(recording.frame_stamps), sigma

    def reset(self, prior, rng):
        self.rng, self.row = rng, -1

    def step(self, frame):
        self.row += 1
        mean = self.truth[self.row] + self.sigma * self.rng.standard_normal(3)
        return Belief(mean, self.sigma**2 * np.eye(3))


def bound_columns(*words):
    (row,) = evaluate(Experiment.compose([*words]))
    return {name: value for name, value in row.items() if "bound" in name}


def test_online_and_revised_estimates_have_bounds_of_their_own():
    found = bound_columns(*STEREO, "estimator=smoother")
    assert set(found) == COLUMNS | {f"revised_{name}" for name in COLUMNS}
    for name in COLUMNS:
        assert 0.0 < found[f"revised_{name}"] < found[name]


def test_landmarks_that_are_known_tell_more():
    unknown, known = (
        bound_columns(*STEREO, "estimator=ekf_slam", f"prior.map={m}") for m in ("none", "world")
    )
    assert set(unknown) == set(known) == COLUMNS
    assert known["bound_rmse_m"] < unknown["bound_rmse_m"]


def written_plainly(recording, start, after_s):
    """Bound of known landmarks, Frame by Frame: RMS position and heading, by finite differences."""
    robot, camera = recording.config["robot"], recording.sensors["stereo"]
    gain = 1.0 + np.array([robot["bias_right"], robot["bias_left"]])
    rates = np.array([robot["kr"], robot["kl"]]) / gain**2
    truth = recording.truth_at(recording.frame_stamps)
    rolled = recording.wheels.at(recording.frame_stamps) / gain
    log, ids = recording.logs["stereo"], recording.truth.readings["stereo"]["true_ids"]
    images = dict(zip(log.stamps.tolist(), np.split(ids, log.splits[1:-1]), strict=True))
    R = np.diag([camera.sigma_column_px, camera.sigma_row_px, camera.sigma_disparity_px]) ** 2

    def in_image(pose, landmark):
        x, y, z = points_in_camera(camera, pose, landmark[None])[0]
        return camera.focal_px / z * np.array([x, y, camera.baseline_m])

    P, squares = start, []
    for k, stamp in enumerate(recording.frame_stamps.tolist()):
        if k:
            wheels = rolled[k] - rolled[k - 1]
            moved = truth[k][:2] - truth[k - 1][:2]
            F, G = np.eye(3), slope(lambda w: rolled_on(truth[k - 1], w, robot["track_m"]), wheels)  # noqa: B023
            F[:2, 2] = -moved[1], moved[0]
            P = F @ P @ F.T + G @ np.diag(rates * np.abs(wheels)) @ G.T
        for i in images.get(stamp, []):
            H = slope(lambda pose: in_image(pose, recording.truth.world.landmarks[i]), truth[k])  # noqa: B023
            P = P - P @ H.T @ np.linalg.solve(H @ P @ H.T + R, H @ P)
        if stamp - recording.frame_stamps[0] >= after_s:
            squares.append(np.diag(P))
    x, y, heading = np.mean(squares, axis=0)
    return np.sqrt(x + y), np.sqrt(heading)


def rolled_on(pose, wheels_m, track_m):
    right, left = wheels_m
    turn, way = (right - left) / track_m, (right + left) / 2.0
    chord = way if abs(turn) < 1e-9 else 2.0 * way / turn * np.sin(turn / 2.0)
    along = pose[2] + turn / 2.0
    return np.array(
        [pose[0] + chord * np.cos(along), pose[1] + chord * np.sin(along), pose[2] + turn]
    )


def test_is_the_bound_written_plainly():
    words = (
        *STEREO,
        "robot.bias_right=0.03",
        "robot.kr=1e-3",
        "sensors.encoder.rate_hz=20",
        "prior.map=world",
        "scoring.after_s=2",
        "estimator=ekf_slam",
    )
    experiment = Experiment.compose([*words])
    recording = experiment.recording()
    plain = written_plainly(recording, experiment.prior(recording).covariance, 2.0)
    found = bound_columns(*words)
    assert (found["bound_rmse_m"], found["bound_heading_rad"]) == pytest.approx(plain, rel=2e-3)


TEAM = (
    "study=teams",
    "estimator=ekf_slam",
    "team.size=2",
    "route.distance_m=4",
    "seed=0",
    "prior.map=world",
)


def test_of_a_team_is_the_bound_written_plainly():
    """A filter over both poses, in which robots see landmarks of the map and each other."""
    one = Experiment.compose([*TEAM])
    team = one.recordings()
    priors = one.priors(team)
    robots, starts = team.robots, [prior.covariance for prior in priors]
    config, camera = robots[0].config["robot"], robots[0].sensors["stereo"]
    clock = np.unique(np.concatenate([robot.frame_stamps for robot in robots]))
    truth = [robot.truth_at(np.clip(clock, *robot.frame_stamps[[0, -1]])) for robot in robots]
    rolled = [robot.wheels.at(np.clip(clock, *robot.frame_stamps[[0, -1]])) for robot in robots]
    world, P = robots[0].truth.world, np.zeros((6, 6))
    P[:3, :3], P[3:, 3:] = starts
    R = np.diag([camera.sigma_column_px, camera.sigma_row_px, camera.sigma_disparity_px]) ** 2

    def looked_at(pose, point):
        x, y, z = points_in_camera(camera, pose, point[None])[0]
        return camera.focal_px / z * np.array([x, y, camera.baseline_m])

    def marker(pose):
        return np.array([*pose[:2], robots[0].sensors["robots"].marker_z_m])

    squares, n_met = np.zeros((2, 3, len(clock))), 0
    for k, stamp in enumerate(clock.tolist()):
        F, Q = np.eye(6), np.zeros((6, 6))
        for i in range(2 if k else 0):
            at, wheels = slice(3 * i, 3 * i + 3), rolled[i][k] - rolled[i][k - 1]
            before = truth[i][k - 1]
            G = slope(lambda w: rolled_on(before, w, config["track_m"]), wheels)  # noqa: B023
            F[3 * i, 3 * i + 2] = -(truth[i][k] - before)[1]
            F[3 * i + 1, 3 * i + 2] = (truth[i][k] - before)[0]
            Q[at, at] = G @ np.diag([config["kr"], config["kl"]] * np.abs(wheels)) @ G.T
        P = F @ P @ F.T + Q
        both = np.concatenate([own[k] for own in truth])
        for i, robot in enumerate(robots):
            for name in ("stereo", "robots"):
                log = robot.logs[name]
                rows = np.flatnonzero(log.stamps == stamp)
                splits, ids = log.splits, robot.truth.readings[name]["true_ids"]
                for number in [n for row in rows for n in ids[splits[row] : splits[row + 1]]]:
                    if name == "robots" and stamp > robots[number].frame_stamps[-1]:
                        continue
                    n_met += name == "robots"

                    def seen(poses, i=i, name=name, number=number):
                        other = poses.reshape(2, 3)[number % 2]
                        point = marker(other) if name == "robots" else world.landmarks[number]
                        return looked_at(poses.reshape(2, 3)[i], point)

                    H = slope(seen, both)
                    P = P - P @ H.T @ np.linalg.solve(H @ P @ H.T + R, H @ P)
        squares[:, :, k] = np.diag(P).reshape(2, 3)
    assert n_met > 3
    found = bounds.bound_team(team, priors, ["stereo", "robots"])
    for i, (robot, bound) in enumerate(zip(robots, found, strict=True)):
        own = squares[i][:, clock <= robot.frame_stamps[-1]]
        np.testing.assert_allclose(np.diagonal(bound.online, 0, 1, 2), own.T, rtol=5e-3, atol=1e-9)


def test_a_robot_of_a_team_alone_has_the_bound_without_sightings():
    both = Experiment.compose([*TEAM]).recordings()
    one = Experiment.compose([*TEAM])
    for robot, prior in zip(both.robots, one.priors(both), strict=True):
        with_others = bounds.bound_recording(robot, prior, ["stereo", "robots"])
        without = bounds.bound_recording(robot, prior, ["stereo"])
        np.testing.assert_array_equal(with_others.online, without.online)


def test_robots_that_see_each_other_know_more():
    met, alone = (
        bound_columns(*TEAM[:-1], f"estimator.robots={robots}") for robots in ("robots", "null")
    )
    assert set(met) == set(alone) == COLUMNS
    assert met["bound_rmse_m"] < alone["bound_rmse_m"]


def test_wheels_that_do_not_slip_and_a_start_that_is_known_leave_nothing():
    exact = (*SHORT, "robot.kr=0", "robot.kl=0", "prior.sigma_position_m=0")
    found = bound_columns(*exact, "prior.sigma_heading_rad=0", "estimator=odometry")
    assert found == dict.fromkeys(COLUMNS, 0.0)


@pytest.mark.parametrize(
    "words",
    [
        (*LASER, "estimator=ekf_icp"),  # no map
        (*LASER, "estimator=mcl", "prior.map=world", "prior.start=global"),
        (*LASER, "estimator=mcl", "prior.map=world", "sensors.laser.sigma_range_m=0"),
        # of another law: it sweeps, and its range is biased
        (*SHORT, "sensors=rplidar_a1", "estimator=mcl", "prior.map=world"),
        # the information about far landmarks is lost in rounding
        (*STEREO, "estimator=ekf_slam", "sensors.stereo.baseline_m=1e-4"),
        # a heading in such doubt bends what is taken as straight
        (*STEREO, "estimator=ekf_slam", "prior.sigma_heading_rad=0.4"),
    ],
)
def test_no_bound_without_what_it_takes(words):
    assert not bound_columns(*words)


@pytest.mark.slow
def test_wheels_alone_are_at_their_bound():
    """On a short way; what else the recording has, odometry does not read."""
    rows = [
        row
        for seed in range(30)
        for row in evaluate(Experiment.compose([*LASER, "estimator=odometry", f"seed={seed}"]))
    ]
    for error, bound in (("ate_rmse_m", "bound_rmse_m"), ("heading_rmse_rad", "bound_heading_rad")):
        squares = np.array([[row[error] ** 2, row[bound] ** 2] for row in rows])
        ratio, p = over_bound(*squares.T)
        assert ratio.low < 1.0 < ratio.high
        assert p > 0.01


def test_no_bound_over_a_real_log_or_another_robot():
    experiment = Experiment.compose([*STEREO, "estimator=ekf_slam"])
    recording = experiment.recording()
    prior = experiment.prior(recording)

    def columns(**changed):
        other = dataclasses.replace(recording, **changed)
        return bounds.bound_recording(other, prior, ["stereo"])

    assert columns() is not None
    truth, robot = recording.known_truth, recording.config["robot"]
    assert columns(truth=None) is None
    assert columns(truth=dataclasses.replace(truth, wheel_travel_m=np.zeros((0, 2)))) is None
    assert columns(config={}) is None
    assert columns(config={"robot": {**robot, "_target_": "elsewhere.Robot"}}) is None


def test_bound_is_made_once_a_recording(monkeypatch):
    made = []
    whole = bounds.bound_path
    monkeypatch.setattr(bounds, "bound_path", lambda chain: made.append(0) or whole(chain))
    bounds._bound.cache_clear()
    for estimator in ("ekf_slam", "fastslam"):
        evaluate(Experiment.compose([*STEREO, f"estimator={estimator}", "repeats=2"]))
    assert len(made) == 1


@pytest.mark.parametrize("given", ["laser", "stereo"])
def test_a_cheat_lies_below_the_bound_and_a_bad_guess_above(given):
    words = [*STEREO] if given == "stereo" else [*LASER, "prior.map=world"]
    plain = Experiment.compose([*words, "estimator=odometry"])
    for sigma, below in ((1e-6, True), (0.3, False)):
        cheat = plain.with_estimator_object(Cheat(plain.recording(), sigma))
        (row,) = evaluate(cheat)
        assert (row["ate_rmse_m"] < row["bound_rmse_m"]) is below
        assert (row["heading_rmse_rad"] < row["bound_heading_rad"]) is below


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ["ekf_slam", "smoother", "mcl"])
def test_no_method_is_significantly_below_the_bound(estimator):
    words = [*DRIVE, "route.distance_m=8", f"estimator={estimator}"]
    if estimator == "mcl":
        start = ["prior.sigma_position_m=0.05", "prior.sigma_heading_rad=0.02"]
        words += ["sensors=hokuyo", "prior.map=world", *start]
    else:
        words += ["sensors=stereo_pixel"]
    rows = [
        row
        for seed in range(1000, 1030)
        for row in evaluate(Experiment.compose([*words, f"seed={seed}"]))
    ]
    of = "revised_" if estimator == "smoother" else ""
    for error, bound in (("ate_rmse_m", "bound_rmse_m"), ("heading_rmse_rad", "bound_heading_rad")):
        squares = np.array([[row[of + error] ** 2, row[of + bound] ** 2] for row in rows])
        assert over_bound(*squares.T)[1] > 0.01
        drawn = np.random.default_rng(0).integers(len(rows), size=(2000, len(rows)))
        errors, least = squares[drawn].sum(axis=1).T
        assert np.quantile(errors / least, 0.975) > 1.0
