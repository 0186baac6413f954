"""The studies and claims of gil2008, on a small recording and on made-up tables."""

import functools
import itertools
import json

import numpy as np
import pandas as pd
import pytest
from joblib import Parallel, delayed

from estimators.landmarks.fastslam import FastSLAM
from experiments.gate.conform import walk
from experiments.judging.claim import Role, Verdict, select, select_all
from experiments.judging.results import Profile
from experiments.judging.sequential import designs
from experiments.papers.gil2008 import claims as judge
from experiments.papers.gil2008 import recordings, scores, settings, study
from experiments.runs.experiment import Experiment
from experiments.sweeps.plan import plan_experiments
from tests.fixtures.claims import concluded
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


def sweep(column, values, effect, *, rng=None, **constant):
    """Rows of every world and value: an error of `effect(value)` with 5 % of noise."""
    rng = rng or np.random.default_rng(0)
    rows = []
    for seed, value in itertools.product(SEEDS, values):
        error = effect(value) * np.exp(0.05 * rng.standard_normal())
        row = {"seed": seed, "draw": 0, "noise": "paper", "filter": "fastslam2", **constant}
        rows.append(
            {
                **row,
                column: value,
                **dict.fromkeys(judge.ERRORS, error),
                "odometry_rmse_m": 3.0,
                judge.HEADING: 0.1 * error,
                "odometry_heading_rmse_rad": 0.3,
            }
        )
    return pd.DataFrame(rows)


def verdicts(claims):
    return [c.verdict for c in claims if c.verdict is not Verdict.SHOWN]


def headlines(claims):
    return [c.verdict for c in claims if c.role is Role.HEADLINE]


def laps(filter_ratio=1.0, odometry_ratio=2.0, name="paper"):
    """Rows of every world: errors at later visits over that at the first, with noise."""
    rng = np.random.default_rng(0)
    own, ours = np.exp(0.4 * rng.standard_normal(40)), np.exp(0.05 * rng.standard_normal(40))
    return pd.DataFrame(
        {
            "seed": range(1000, 1040),
            "noise": "paper",
            "filter": name,
            "revisit_ratio": filter_ratio * ours,
            "odometry_revisit_ratio": odometry_ratio * own,
        }
    )


def test_gi1_holds_slam_against_odometry():
    good = sweep("n_particles", PARTICLES, lambda m: 0.5, filter="paper")
    assert headlines(judge.gi1(good, laps())) == ["reproduced"] * 3
    bad = good.assign(revised_ate_rmse_m=2.5, revised_heading_rmse_rad=0.5)
    assert headlines(judge.gi1(bad, laps(1.5))) == ["not_reproduced"] * 3
    for error_m, verdict in ((1.45, "reproduced"), (1.55, "not_reproduced")):  # odometry's is 3
        near = judge.gi1(good.assign(revised_ate_rmse_m=error_m), laps())
        assert headlines(near)[0] == verdict
    ours = pd.concat([laps(), laps(1.5, name="fastslam2")])  # stands beside
    assert headlines(judge.gi1(good, ours)) == ["reproduced"] * 3
    said = concluded("gil2008", judge.gi1(good, laps()))
    assert said.verdict == "reproduced"
    first, second, *_ = said.sentence.split(". ")  # a sentence a course
    assert "course of 146 m" in first
    assert "second course, of four laps" in second
    assert (
        "The paper's own design is one drive: 20 of 20 such trials show what it says."
        in said.sentence
    )


@pytest.mark.parametrize("seed", [0, 1])
def test_the_laps_are_the_worlds_own_tour(seed):
    """Objects keep clear of it alone; on another course the robot would hit them."""
    course = Experiment.compose(["study=gil2008/laps", f"seed={seed}"])
    tour = course.world().waypoints
    assert course.config["route"]["waypoints"] is None
    lap_m = np.hypot(*np.diff(tour, axis=0).T).sum()
    assert lap_m == pytest.approx(60.0)
    assert course.config["route"]["distance_m"] == 4 * lap_m


def test_dead_reckoning_fails_gi1():
    """Odometry in the filter's place is told from a filter, or the course is called too short."""
    drive = sweep("n_particles", PARTICLES, lambda m: 3.0, filter="paper")
    lost = laps(2.0).assign(revisit_ratio=lambda table: table["odometry_revisit_ratio"])
    found = headlines(judge.gi1(drive, lost))
    assert (found[0], found[2]) == ("not_reproduced", "not_reproduced")
    short = list(judge.gi1(drive, laps(1.0, odometry_ratio=1.0)))
    assert headlines(short)[2] == "undecided"
    own = select(short, quantity="revisits", method="odometry")
    assert (own.verdict, own.role) == ("not_reproduced", "beside")


def test_more_laps_are_driven_while_odometry_does_not_clearly_drift():
    own, ours = judge.revisits(laps(1.0, odometry_ratio=1.3), designs("gil2008")["GI1"])
    assert (own.verdict, ours.verdict) == ("undecided", "undecided")
    assert ours.facts["is_open"]
    own, ours = judge.revisits(laps(1.0, odometry_ratio=1.0), designs("gil2008")["GI1"])
    assert (own.verdict, ours.verdict) == ("not_reproduced", "undecided")
    assert not ours.facts["is_open"]  # it is decided that this course cannot tell


def test_gi2_and_gi3_tell_a_trend_from_none():
    def table(effect):
        return pd.concat(
            sweep("n_particles", PARTICLES, effect, filter=f) for f in ("paper", "fastslam2")
        )

    bound = sweep("n_particles", [0], lambda m: 0.1).assign(filter="batch")
    falling, flat = table(lambda m: m**-0.4), table(lambda m: 0.3)
    assert set(verdicts(judge.gi2(falling, bound))) == {"reproduced"}
    assert len(headlines(judge.gi2(falling, bound))) == 2
    assert "reproduced" not in verdicts(judge.gi2(flat, bound))
    assert headlines(judge.gi3(flat)) == ["reproduced"]
    assert headlines(judge.gi3(falling)) == ["not_reproduced"]
    shown = select_all(list(judge.gi2(falling, bound)), quantity="position over bound")
    assert shown[0].found.value == pytest.approx(500**-0.4 / 0.1, rel=0.1)
    assert concluded("gil2008", judge.gi2(flat, bound)).verdict != "reproduced"


def test_gi3_states_equivalence_and_significance_apart():
    """A gain of 10 % is significant, and within 25 %; noisy recordings decide neither."""
    some = sweep("n_particles", (200, 1000), lambda m: 1.1 if m == 200 else 1.0, filter="paper")
    same, plainly = list(judge.gi3(some))[:2]
    assert (same.verdict, plainly.verdict) == ("reproduced", "not_reproduced")
    assert (same.role, plainly.role) == ("headline", "beside")
    said = concluded("gil2008", [same, plainly]).sentence
    assert "the gain is significant, and the error differs by less than 25 %" in said
    noise = np.exp(np.random.default_rng(1).standard_normal(len(some)))
    wide = some.assign(revised_ate_rmse_m=some["revised_ate_rmse_m"] * noise)
    same, plainly = list(judge.gi3(wide))[:2]
    assert (same.verdict, plainly.verdict) == ("undecided", "reproduced")
    assert same.power < 0.1


def test_ratios_are_taken_within_a_recording():
    table = pd.DataFrame(
        [(s, d, m, (1.0 + 9.0 * d) * (2.0 if m == 200 else 1.0)) for s in (1, 2) for d in (0, 1)
         for m in (200, 1000)],
        columns=["seed", "draw", "n_particles", "e"],
    )  # fmt: skip
    np.testing.assert_allclose(judge.ratios(table, "e", "n_particles", 200, 1000), [2.0, 2.0])


def test_gi4_and_gi5_read_the_distance():
    def distances(effect, **constant):
        kind = {"occluded": True, "n_seen": 0, "rule": "random", "share_beyond_10_m": 0.3}
        every = {**kind, "filter": "paper", **constant}
        return sweep("max_distance_m", (3, 5, 10, 20), effect, **every)

    levelling = distances(lambda d: 3.0 / min(d, 10.0))
    both = ["reproduced", "reproduced"]  # of path and map
    assert headlines(judge.gi4(levelling)) == headlines(judge.gi5(levelling)) == both
    falling = distances(lambda d: 3.0 / d)
    assert headlines(judge.gi5(falling)) == ["not_reproduced", "not_reproduced"]
    of_map = falling.assign(revised_ate_rmse_m=levelling["revised_ate_rmse_m"])
    assert headlines(judge.gi5(of_map)) == ["reproduced", "not_reproduced"]
    assert concluded("gil2008", judge.gi5(of_map)).verdict == "not_reproduced"
    worse = distances(lambda d: 3.0 * d)
    assert headlines(judge.gi5(worse)) == both  # far landmarks that harm agree
    assert concluded("gil2008", judge.gi5(worse)).verdict == "reproduced"
    flat = distances(lambda d: 1.0)
    assert headlines(judge.gi4(flat)) == ["not_reproduced", "not_reproduced"]
    assert concluded("gil2008", judge.gi4(flat)).verdict == "not_reproduced"
    claim = next(judge.gi5(distances(lambda d: 1.0, share_beyond_10_m=0.05)))
    assert claim.verdict == "undecided"
    assert claim.reason == "5 % of observations beyond 10 m; too few far observations"
    assert verdicts(judge.gi4(distances(lambda d: 1.0, rule="nearest", n_seen=8))) == []
    assert verdicts(judge.gi4(distances(lambda d: 1.0, occluded=False))) == []
    for other in ({"filter": "fastslam2"}, {"occluded": False}, {"noise": "pixel"}, {"n_seen": 8}):
        assert headlines(judge.gi5(distances(lambda d: 1.0, **other))) == []


def test_gi3_states_what_the_papers_own_design_shows():
    some = sweep("n_particles", (200, 1000), lambda m: 1.1 if m == 200 else 1.0, filter="paper")
    runs = some.assign(image_draw=some["seed"] - 999)
    for noise, words in ((3.0, "it sees no gain"), (0.0, "it sees a gain")):
        own = runs.copy()
        rng = np.random.default_rng(0)
        own[judge.POSITION] = own["n_particles"].map({200: 1.1, 1000: 1.0})
        own[judge.POSITION] *= np.exp(0.01 * (1.0 + 20 * noise) * rng.standard_normal(len(own)))
        said = concluded("gil2008", judge.gi3(some, own)).sentence
        assert "one drive with 20 runs" in said
        assert words in said


def test_gi6_reads_the_number_of_observations():
    more = sweep("n_seen", (1, 2, 4, 8, 12, 20), lambda b: b**-0.3, filter="paper")
    assert set(verdicts(judge.gi6(more))) == {"reproduced"}
    assert concluded("gil2008", judge.gi6(more)).verdict == "reproduced"
    fewer = more.assign(n_seen=21 - more["n_seen"])
    assert set(verdicts(judge.gi6(fewer))) == {"not_reproduced"}


def associated(descriptor=0.52, fastslam=0.9, ekf=3.5, name="paper", diverging=20):
    """Errors by association; EKF-SLAM has its own in so many worlds, and FastSLAM's in others."""
    rng = np.random.default_rng(0)
    rows = []
    for i, seed in enumerate(SEEDS):
        single = ekf if i < diverging else fastslam
        for who, how, error in (
            (name, "known", 0.5),
            (name, "descriptor", descriptor),
            (name, "mahalanobis", fastslam),
            ("ekf_slam", "mahalanobis", single),
        ):
            rows.append(
                {
                    "seed": seed,
                    "noise": "paper",
                    "filter": who,
                    "association": how,
                    "p0": 1e-3,
                    "sigma_descriptor": 0.9,
                    "revised_ate_rmse_m": error * np.exp(0.1 * rng.standard_normal()),
                    "ate_rmse_m": error,
                    "odometry_rmse_m": 3.0,
                    "right_share": 0.9,
                    "matching_precision": 0.8,
                }
            )
    return pd.DataFrame(rows)


def test_gi7_compares_associations():
    assert headlines(judge.gi7(associated())) == ["reproduced", "reproduced"]
    assert headlines(judge.gi7(associated(descriptor=0.9)))[0] == "not_reproduced"
    assert headlines(judge.gi7(associated(fastslam=3.5, ekf=0.9)))[1] == "not_reproduced"
    said = concluded("gil2008", judge.gi7(associated()))
    assert said.verdict == "reproduced"
    assert "worse than odometry in 100 % of the worlds, the printed filter in 0 %" in said.sentence
    fastslam2 = associated(descriptor=5.0, name="fastslam2").query("filter == 'fastslam2'")
    ours = pd.concat([associated(), fastslam2])
    assert headlines(judge.gi7(ours)) == ["reproduced", "reproduced"]  # ours stands beside


def test_gi7_compares_filters_that_take_r_at_the_same_point():
    table = associated().assign(noise_at="measured")
    single = table["filter"] == "ekf_slam"
    other = table[single].assign(noise_at="predicted", ate_rmse_m=0.5)  # does not diverge
    assert headlines(judge.gi7(pd.concat([other, table]))) == ["reproduced", "reproduced"]
    apart = pd.concat([other, table.assign(ate_rmse_m=0.9)])
    assert headlines(judge.gi7(apart))[1] == "not_reproduced"  # neither ever diverges


def test_gi7_counts_the_worlds_in_which_one_filter_alone_diverges():
    few, enough = (list(judge.gi7(associated(diverging=n)))[1] for n in (4, 8))
    assert (few.verdict, enough.verdict) == ("undecided", "reproduced")
    assert few.reason.endswith("p = 0.062")
    assert 0.0 < few.power < 1.0
    assert headlines(judge.gi7(associated(fastslam=3.5)))[1] == "not_reproduced"  # none does more
    assert few.facts["is_open"]  # until there are worlds enough to tell no effect


def test_gi8_reads_exponents():
    rng = np.random.default_rng(0)
    rows = [
        {
            "repeat": repeat,
            "maps": maps,
            "association": ids,
            "n_landmarks": n,
            "step_ms": (n / 100) ** power * np.exp(0.02 * rng.standard_normal()),
        }
        for repeat in range(4)
        for maps, power in (("shared", 0.1), ("contiguous", 1.0))
        for ids in ("known", "unknown")
        for n in (100, 200, 400, 800)
    ]
    said = concluded("gil2008", judge.gi8(table := pd.DataFrame(rows)))
    assert said.verdict == "reproduced"
    assert "grows as N^0.10 with maps that particles share until one writes" in said.sentence
    swapped = table.replace({"maps": {"contiguous": "shared", "shared": "contiguous"}})
    assert headlines(judge.gi8(swapped)) == ["not_reproduced", "not_reproduced"]


def test_interval_of_a_median():
    values = np.arange(1.0, 21.0)
    found = judge.median_interval(values)
    assert (found.value, found.low, found.high) == (10.5, 6.0, 15.0)
    assert np.isnan(judge.median_interval(values[:4]).low)
