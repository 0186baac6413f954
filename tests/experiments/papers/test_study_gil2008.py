"""The studies of gil2008, on a small recording."""

import functools
import itertools
import json

import numpy as np
import pytest
from joblib import Parallel, delayed

from estimators.landmarks.fastslam import FastSLAM
from experiments.gate.conform import walk
from experiments.judging.results import Profile
from experiments.papers.gil2008 import recordings, scores, settings, study
from experiments.runs.experiment import Experiment
from experiments.sweeps.plan import plan_experiments
from tests.fixtures.fakes import circle, tracking_prior, true_ids

K_M = 3.21e-5
SEEDS = range(1000, 1020)
PARTICLES = (10, 50, 100, 200, 300, 500, 1000)


@pytest.fixture
def small(monkeypatch):
    """Every drive is a circle in a square room."""
    driven = circle(seed=1, n_frames=240, kr=K_M, kl=K_M)
    monkeypatch.setattr(Experiment, "recording", lambda self: driven)
    return driven


def experiment(*overrides, study="gil2008"):
    return Experiment.compose([f"study={study}", "seed=3", "estimator.n_particles=30", *overrides])


def recorded(*overrides):
    return recordings.recorded(experiment(*overrides).config)


def everything(*overrides):
    """All that the camera can see."""
    return recorded("sensors.stereo.max_distance_m=20", *overrides)


def ids_of(recording):
    log = recording.log("stereo")
    return [set(log["ids"][a:b]) for a, b in itertools.pairwise(log.splits)]


def test_fewer_observations_are_a_part_of_more(small):
    shown = {}
    for n_seen in (1, 3, 0):
        thin = recorded(f"sensors.stereo.max_observations={n_seen}")
        shown[n_seen] = ids_of(thin)
        assert np.array_equal(thin.log("stereo")["ids"], true_ids(thin))
    assert max(map(len, shown[1])) == 1
    assert max(map(len, shown[3])) == 3
    assert all(a <= b <= c for a, b, c in zip(*shown.values(), strict=True))


def test_arms_keep_what_is_near(small):
    recording, near = everything(), recorded("sensors.stereo.max_distance_m=3.0")
    distance = np.linalg.norm(near.log("stereo")["points_in_camera"], axis=1)
    assert 0 < len(distance) < len(recording.log("stereo")["ids"])
    assert np.quantile(distance, 0.9) < 3.5  # the measured one is noisy
    assert near.sensors["stereo"].max_distance_m == 3.0
    assert recordings.landmark_distances_m(near).max() <= 3.0
    nearest = recorded("sensors.stereo.max_observations=1", "sensors.stereo.selection=nearest")
    mean = [np.mean(r.log("stereo")["points_in_camera"][:, 2]) for r in (nearest, recording)]
    assert mean[0] < 0.8 * mean[1]


def test_walls_hide_landmarks(small):
    free, hidden = (everything(f"recording.occluded={o}") for o in (False, True))
    assert len(free.log("stereo")["ids"]) >= len(hidden.log("stereo")["ids"])
    assert np.array_equal(free.truth.poses, hidden.truth.poses)


def test_further_wheel_errors_keep_their_law(small):
    config = experiment().config

    def wheels(draw):
        drawn = {**config, "recording": {**config["recording"], "draw": draw}}
        return recordings.recorded(drawn).wheels.position_m

    ground = np.diff(small.truth.wheel_travel_m, axis=0)
    errors = np.array([np.diff(wheels(draw), axis=0) - ground for draw in range(1, 41)])
    whitened = errors / np.sqrt(K_M * np.abs(ground))
    assert np.std(whitened) == pytest.approx(1.0, abs=0.02)
    assert abs(np.mean(whitened)) < 0.02
    assert np.array_equal(wheels(5), wheels(5))


def test_noise_of_descriptors_alone_leaves_the_images(small):
    first, second = (everything(f"sensors.stereo.sigma_descriptor={s}") for s in (0.1, 0.9))
    assert np.array_equal(
        first.log("stereo")["points_in_camera"], second.log("stereo")["points_in_camera"]
    )


def test_each_draw_has_its_own_images_over_the_same_wheels(small):
    first, again = (everything(f"recording.image_draw={i}") for i in (0, 1))
    assert np.array_equal(first.wheels.position_m, again.wheels.position_m)
    assert np.array_equal(first.truth.poses, again.truth.poses)
    seen, other = first.log("stereo"), again.log("stereo")
    assert np.array_equal(seen["ids"], other["ids"])
    assert not np.array_equal(seen["points_in_camera"], other["points_in_camera"])


def test_recordings_with_other_cameras_have_other_keys():
    keys = [experiment(f"sensors.stereo.max_distance_m={d}").recording_key for d in (3, 5)]
    assert keys[0] != keys[1]


def test_rows_say_what_was_run(small):
    noise = "sensors=stereo_pixel"
    batch = Experiment.compose(["study=gil2008", "seed=3", noise, "estimator=smoother"])
    runs = [("particles", experiment(noise, "repeats=2")), ("bound", batch)]
    rows = study.rows_of(runs)
    assert list(rows) == ["particles", "bound"]
    first, second = rows["particles"]
    (bound,) = rows["bound"]
    assert first["revised_ate_rmse_m"] != second["revised_ate_rmse_m"]
    assert first["right_share"] == 1.0
    assert first["share_beyond_10_m"] == 0.0
    for row in (first, bound):
        assert row["revised_ate_rmse_m"] < 0.5 * row["odometry_rmse_m"]
        assert row["map_aligned_rmse_m"] <= row["map_rmse_m"] + 1e-12
    again = study.rows_of(runs[:1])
    assert again["particles"][0]["revised_ate_rmse_m"] == first["revised_ate_rmse_m"]


def test_association_in_studies(small):
    guess = ["sensors.stereo.identifies=false", "estimator.association=mahalanobis"]
    single = ["study=gil2008", "seed=3", "estimator=ekf_slam", "sensors=stereo_pixel", *guess]
    runs = [
        ("association", experiment("sensors=stereo_pixel", *guess)),
        ("association", Experiment.compose(single)),
    ]
    for row in study.rows_of(runs)["association"]:
        assert 0.7 < row["right_share"] <= 1.0


def test_right_associations_are_counted():
    recording = circle(n_frames=4)
    true = true_ids(recording)
    _, first, inverse = np.unique(true, return_index=True, return_inverse=True)
    right = first[inverse]
    assert scores.right_share(recording, [right]) == 1.0
    wrong = right.copy()
    wrong[-1] = -1
    assert scores.right_share(recording, [wrong]) == pytest.approx(1 - 1 / len(true))
    assert scores.right_share(recording, [np.arange(len(true))]) == pytest.approx(
        len(first) / len(true)
    )


def test_revisited_ground_is_where_the_robot_was_long_before():
    along = np.linspace(0.0, 80.0, 401)
    lap = 40.0
    angle = 2 * np.pi * along / lap
    radius = lap / (2 * np.pi)
    poses = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), angle])
    again = scores.on_revisited_ground(poses)
    assert not again[along < 38.5].any()
    assert again[along > 40.0].all()
    growing = poses + np.column_stack([0.01 * along, 0 * along, 0 * along])
    # places first seen after 20 to 40 m, and again after 60 to 80 m
    assert scores.revisit_ratio(poses, growing) == pytest.approx(70.0 / 30.0, rel=0.05)
    level = poses + np.array([0.3, 0.0, 0.0])
    assert scores.revisit_ratio(poses, level) == pytest.approx(1.0)
    early = poses + np.column_stack([np.minimum(along, 20.0), 0 * along, 0 * along])
    assert scores.revisit_ratio(poses, early) == pytest.approx(1.0, abs=0.05)  # near the start
    assert np.isnan(scores.revisit_ratio(poses[:150], level[:150]))


@pytest.mark.slow
def test_plans_are_within_their_means(monkeypatch):
    composed = functools.cache(lambda *lines: list(plan_experiments(lines)))
    monkeypatch.setattr(study, "plan_experiments", lambda lines: composed(*lines))
    full, quick = (list(study.plan(profile)) for profile in (Profile.FULL, Profile.QUICK))
    n_full, n_quick = (sum(run.repeats for _, run in runs) for runs in (full, quick))
    assert n_full < 9000
    assert n_quick < 500

    def kind(table, run):
        """A run, whatever its world and repeat."""
        draws = {key: min(run.config["recording"][key], 1) for key in ("draw", "image_draw")}
        recording = {**run.config["recording"], **draws}
        other = {"seed": 0, "world_seed": 0, "repeats": 1, "recording": recording}
        return table, json.dumps({**run.config, **other})

    bound = {json.dumps(run.config) for table, run in full if table == "bound"}
    assert bound == {json.dumps(run.config) for run in plan_experiments(["study=gil2008/bound"])}

    # the quick one leaves out worlds and repeats, but nothing that is judged or drawn
    assert {kind(*run) for run in full} == {kind(*run) for run in quick}


def _means(seed):
    recording = circle(seed=seed, n_frames=60)
    estimator = FastSLAM(n_particles=40)
    return walk(estimator, recording, tracking_prior(recording), seed)[0]


@pytest.mark.slow
def test_the_number_of_processes_changes_no_bit():
    alone, together = (Parallel(n_jobs=n)(delayed(_means)(s) for s in range(4)) for n in (1, 2))
    assert all(np.array_equal(a, b) for a, b in zip(alone, together, strict=True))


STUDIES = [f"gil2008/{t}" for t in settings.LABELS if t not in settings.SHARED]


@pytest.mark.parametrize("name", ["gil2008", *STUDIES])
def test_studies_compose(name):
    composed = Experiment.compose([f"study={name}"])
    assert composed.name == name.replace("/", "_")
    assert composed.config["sensors"]["stereo"] is not None


# Claims on tables whose answer is known


@pytest.mark.parametrize("seed", [0, 1])
def test_the_laps_are_the_worlds_own_tour(seed):
    """Objects keep clear of it alone; on another course the robot would hit them."""
    course = Experiment.compose(["study=gil2008/laps", f"seed={seed}"])
    tour = course.world().waypoints
    assert course.config["route"]["waypoints"] is None
    lap_m = np.hypot(*np.diff(tour, axis=0).T).sum()
    assert lap_m == pytest.approx(60.0)
    assert course.config["route"]["distance_m"] == 4 * lap_m
