"""The studies and claims of gil2008, on a small recording and on made-up tables."""

import dataclasses
import itertools

import numpy as np
import pandas as pd
import pytest
from joblib import Parallel, delayed

from estimators.fastslam import FastSLAM
from experiments.gate.conform import walk
from experiments.papers.gil2008 import claims as judge
from experiments.papers.gil2008 import study
from experiments.papers.gil2008.study import Arm, Scene
from tests.fakes import circle, tracking_prior

SEEDS = range(1000, 1020)


@pytest.fixture
def small(monkeypatch):
    """Every drive is a circle in a square room."""
    driven = circle(seed=1, n_frames=240, kr=study.K_M, kl=study.K_M)
    monkeypatch.setattr(study, "drive", lambda seed: driven)
    return driven


def arm(**settings):
    options = study.options("fastslam2", n_particles=30)
    return Arm("test", (("filter", "fastslam2"),), options, **settings)


def ids_of(recording):
    log = recording.landmarks
    return [set(log.ids[a:b]) for a, b in itertools.pairwise(log.splits)]


def test_fewer_observations_are_a_part_of_more(small):
    recording = study.recorded(Scene(3))
    shown = {}
    for n_seen in (1, 3, 0):
        thin, _ = study.thinned(recording, arm(n_seen=n_seen), np.random.default_rng(0))
        shown[n_seen] = ids_of(thin)
        assert np.array_equal(thin.landmarks.ids, thin.truth.landmark_ids)
    assert max(map(len, shown[1])) == 1
    assert max(map(len, shown[3])) == 3
    assert all(a <= b <= c for a, b, c in zip(*shown.values(), strict=True))


def test_arms_keep_what_is_near(small):
    recording = study.recorded(Scene(3))
    near, told = study.thinned(recording, arm(max_distance_m=3.0), np.random.default_rng(0))
    distance = np.linalg.norm(near.landmarks.points_in_camera, axis=1)
    assert 0 < len(distance) < len(recording.landmarks.ids)
    assert np.quantile(distance, 0.9) < 3.5  # the measured one is noisy
    assert near.sensors.stereo.max_distance_m == 3.0
    assert told["share_beyond_10_m"] == 0.0
    nearest, _ = study.thinned(recording, arm(n_seen=1, rule="nearest"), np.random.default_rng(0))
    mean = [np.mean(r.landmarks.points_in_camera[:, 2]) for r in (nearest, recording)]
    assert mean[0] < 0.8 * mean[1]


def test_walls_hide_landmarks(small):
    free, hidden = (study.recorded(Scene(3, occluded=o)) for o in (False, True))
    assert len(free.landmarks.ids) >= len(hidden.landmarks.ids)
    assert np.array_equal(free.truth.poses, hidden.truth.poses)


def test_wheel_errors_drawn_anew_keep_their_law(small):
    ground = np.diff(small.truth.wheel_travel_m, axis=0)
    errors = np.array(
        [
            np.diff(study.recorded(Scene(3, draw=d)).wheels.position_m, axis=0) - ground
            for d in range(1, 41)
        ]
    )
    whitened = errors / np.sqrt(study.K_M * np.abs(ground))
    assert np.std(whitened) == pytest.approx(1.0, abs=0.02)
    assert abs(np.mean(whitened)) < 0.02
    again = study.recorded(Scene(3, draw=5)).wheels.position_m
    assert np.array_equal(again, study.recorded(Scene(3, draw=5)).wheels.position_m)


def test_noise_of_descriptors_alone_leaves_the_images(small):
    first, second = (study.recorded(Scene(3, sigma_descriptor=s)) for s in (0.1, 0.9))
    assert np.array_equal(first.landmarks.points_in_camera, second.landmarks.points_in_camera)


def test_rows_say_what_was_run(small):
    arms = [arm(repeats=2), Arm("bound", (("filter", "batch"),), (), method="batch")]
    rows = list(study.runs_of(Scene(3, noise="pixel"), arms))
    assert [table for table, _ in rows] == ["test", "test", "bound"]
    first, second, batch = (row for _, row in rows)
    assert first["revised_rmse_m"] != second["revised_rmse_m"]
    assert first["right_share"] == 1.0
    for row in (first, batch):
        assert row["revised_rmse_m"] < 0.5 * row["odometry_rmse_m"]
        assert row["map_aligned_rmse_m"] <= row["map_rmse_m"] + 1e-12
    again = list(study.runs_of(Scene(3, noise="pixel"), arms[:1]))
    assert again[0][1]["revised_rmse_m"] == first["revised_rmse_m"]


def test_association_in_studies(small):
    guess = study.options("fastslam2", n_particles=30, association="mahalanobis")
    told = (("association", "mahalanobis"),)
    arms = [Arm("a", (), guess), Arm("a", (), told, method="ekf_slam")]
    for _, row in study.runs_of(Scene(3, noise="pixel"), arms):
        assert 0.7 < row["right_share"] <= 1.0


def test_right_associations_are_counted():
    recording = circle(n_frames=4)
    told = recording.truth.landmark_ids
    _, first, inverse = np.unique(told, return_index=True, return_inverse=True)
    right = first[inverse]
    assert study.right_share(recording, [right]) == 1.0
    wrong = right.copy()
    wrong[-1] = -1
    assert study.right_share(recording, [None, wrong]) == pytest.approx(1 - 1 / len(told))
    assert study.right_share(recording, [np.arange(len(told))]) == pytest.approx(
        len(first) / len(told)
    )


def test_revisited_ground_is_where_the_robot_was_long_before():
    along = np.linspace(0.0, 80.0, 401)
    lap = 40.0
    angle = 2 * np.pi * along / lap
    radius = lap / (2 * np.pi)
    poses = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), angle])
    again = study.revisited(poses)
    assert not again[along < 38.5].any()
    assert again[along > 40.0].all()
    growing = poses + np.column_stack([0.01 * along, 0 * along, 0 * along])
    assert study.revisited_slope(poses, growing) == pytest.approx(0.01, rel=0.01)


def test_plans_are_within_their_means():
    full, quick = study.plan("full"), study.plan("quick")
    assert {scene.seed for scene in full} == set(SEEDS)
    runs = [sum(a.repeats for arms in plan.values() for a in arms) for plan in (full, quick)]
    assert runs[0] < 3000
    assert runs[1] < 300
    # the quick one leaves out worlds and repeats, but nothing that is judged or drawn
    first, second = (
        {
            (
                dataclasses.replace(scene, seed=0, draw=min(scene.draw, 1)),
                dataclasses.replace(arm, repeats=1),
            )
            for scene, arms in plan.items()
            for arm in arms
        }
        for plan in (full, quick)
    )
    assert first == second


def _means(seed):
    recording = circle(seed=seed, n_frames=60)
    estimator = FastSLAM(n_particles=40)
    return walk(estimator, recording, tracking_prior(recording), seed)[0]


@pytest.mark.slow
def test_the_number_of_processes_changes_no_bit():
    alone, together = (Parallel(n_jobs=n)(delayed(_means)(s) for s in range(4)) for n in (1, 2))
    assert all(np.array_equal(a, b) for a, b in zip(alone, together, strict=True))


@pytest.mark.parametrize(
    "name",
    ["path", "particles", "distance", "observations", "resampling", "noise", "association"],
)
def test_studies_compose(name):
    config = compose([f"study=gil2008_{name}"])
    assert config["name"] == f"gil2008_{name}"
    assert config["sensors"]["stereo"] is not None


# Claims on tables whose answer is known


def sweep(column, values, effect, *, rng=None, **constant):
    """Rows of every world and value: an error of `effect(value)` with 10 % of noise."""
    rng = rng or np.random.default_rng(0)
    rows = []
    for seed, value in itertools.product(SEEDS, values):
        error = effect(value) * np.exp(0.1 * rng.standard_normal())
        row = {"seed": seed, "draw": 0, "noise": "paper", "filter": "fastslam2", **constant}
        rows.append(
            {
                **row,
                column: value,
                **dict.fromkeys(judge.ERRORS, error),
                "odometry_rmse_m": 3.0,
                "slope": -1e-3 * abs(rng.standard_normal()) - 1e-4,
            }
        )
    return pd.DataFrame(rows)


def verdicts(claims):
    return [c.verdict for c in claims if not c.verdict.startswith("shown")]


def test_gi1_holds_slam_against_odometry():
    good = sweep("n_particles", study.PARTICLES, lambda m: 0.5)
    assert verdicts(judge.gi1(good)) == ["reproduced", "reproduced"]
    bad = good.assign(revised_rmse_m=2.5, slope=good["slope"].abs())
    assert verdicts(judge.gi1(bad)) == ["not reproduced", "not reproduced"]


def test_gi2_and_gi3_tell_a_trend_from_none():
    bound = sweep("n_particles", [0], lambda m: 0.1).assign(filter="batch")
    falling = sweep("n_particles", study.PARTICLES, lambda m: m**-0.4)
    flat = sweep("n_particles", study.PARTICLES, lambda m: 0.3)
    assert set(verdicts(judge.gi2(falling, bound))) == {"reproduced"}
    assert "reproduced" not in verdicts(judge.gi2(flat, bound))
    assert set(verdicts(judge.gi3(flat))) == {"reproduced"}
    assert set(verdicts(judge.gi3(falling))) == {"not reproduced"}
    shown = [c for c in judge.gi2(falling, bound) if "batch bound" in c.statistic]
    assert shown[0].value == pytest.approx(500**-0.4 / 0.1, rel=0.1)


def test_gi4_and_gi5_read_the_distance():
    def distances(effect, **constant):
        kind = {"occluded": True, "n_seen": 0, "rule": "random", "share_beyond_10_m": 0.3}
        return sweep("max_distance_m", study.DISTANCES_M, effect, **{**kind, **constant})

    levelling = distances(lambda d: 3.0 / min(d, 10.0))
    assert verdicts(judge.gi4(levelling)) == ["reproduced"]
    assert verdicts(judge.gi5(levelling)) == ["reproduced"]
    falling = distances(lambda d: 3.0 / d)
    assert verdicts(judge.gi5(falling)) == ["not reproduced"]
    assert verdicts(judge.gi4(distances(lambda d: 1.0))) == ["not reproduced"]
    few = distances(lambda d: 1.0, share_beyond_10_m=0.05)
    assert verdicts(judge.gi5(few)) == ["undecided: too few far observations"]
    assert verdicts(judge.gi4(distances(lambda d: 1.0, rule="nearest", n_seen=8))) == []
    assert verdicts(judge.gi4(distances(lambda d: 1.0, occluded=False))) == []


def test_gi6_reads_the_number_of_observations():
    more = sweep("n_seen", study.OBSERVATIONS, lambda b: b**-0.3)
    assert set(verdicts(judge.gi6(more))) == {"reproduced"}
    assert "reproduced" not in verdicts(judge.gi6(more.assign(n_seen=21 - more["n_seen"])))


def test_gi7_compares_associations():
    rng = np.random.default_rng(0)
    rows = []
    for seed in SEEDS:
        for name, how, error in (
            ("fastslam2", "known", 0.5),
            ("fastslam2", "descriptor", 0.52),
            ("fastslam2", "mahalanobis", 0.9),
            ("ekf_slam", "mahalanobis", 2.5),
        ):
            rows.append(
                {
                    "seed": seed,
                    "noise": "paper",
                    "filter": name,
                    "association": how,
                    "p0": 1e-3,
                    "sigma_descriptor": 0.9,
                    "revised_rmse_m": error * np.exp(0.1 * rng.standard_normal()),
                    "online_rmse_m": error,
                    "odometry_rmse_m": 3.0,
                    "right_share": 0.9,
                    "matching_precision": 0.8,
                }
            )
    table = pd.DataFrame(rows)
    assert verdicts(judge.gi7(table)) == ["reproduced", "reproduced"]
    swapped = table.assign(online_rmse_m=3.1 - table["online_rmse_m"])
    assert verdicts(judge.gi7(swapped))[1] == "not reproduced"


def test_gi8_reads_exponents():
    rng = np.random.default_rng(0)
    rows = [
        {
            "repeat": repeat,
            "maps": maps,
            "n_landmarks": n,
            "step_ms": (n / 100) ** power * np.exp(0.02 * rng.standard_normal()),
        }
        for repeat in range(4)
        for maps, power in (("shared", 0.1), ("contiguous", 1.0))
        for n in (100, 200, 400, 800)
    ]
    table = pd.DataFrame(rows)
    assert verdicts(judge.gi8(table)) == ["reproduced", "reproduced"]
    linear = table[table["maps"] == "contiguous"].assign(maps="shared")
    both = pd.concat([linear, table[table["maps"] == "contiguous"]])
    assert verdicts(judge.gi8(both))[0] == "not reproduced"


def test_interval_of_a_median():
    values = np.arange(1.0, 21.0)
    found = judge.median_interval(values)
    assert (found.value, found.low, found.high) == (10.5, 6.0, 15.0)
    assert np.isnan(judge.median_interval(values[:4]).low)
