"""What is compared differs in nothing but what is compared: starts, stops, seeds, beliefs."""

import json
from functools import cache, partial

import numpy as np
import pytest

from estimators.laser import icp
from experiments.bench import icp as bench
from experiments.papers.decristoforis2020 import pairs
from experiments.papers.decristoforis2020 import study as decristoforis2020
from experiments.papers.gil2008 import study
from experiments.papers.gil2008.recordings import Scene
from experiments.papers.maximo2024 import worlds
from experiments.papers.puzzlebot2024 import study as puzzlebot2024
from experiments.runs.experiment import Experiment
from experiments.studies.real_logs.settings import FUSION, INTEL
from experiments.sweeps.plan import plan_experiments

STEREO = {"sensors.stereo.correlated", "sensors.stereo.sigma_column_px"} | {
    "sensors.stereo.sigma_row_px"
}
CHOSEN = {"fastslam": 7.81, "ekf_slam": 7.81, "fastslam_paper": 7.81}  # thresholds of distance


def flat(config, prefix=""):
    for key, value in config.items():
        if isinstance(value, dict):
            yield from flat(value, f"{prefix}{key}.")
        else:
            yield prefix + key, json.dumps(value)


def differing(experiments):
    """Keys, but those of the estimator, in which experiments differ."""
    configs = [dict(flat(experiment.config)) for experiment in experiments]
    keys = set().union(*configs)
    found = {key for key in keys if len({config.get(key) for config in configs}) > 1}
    return {key for key in found if not key.startswith("estimator.")}


@cache
def of_one_seed(name):
    return [run for run in plan_experiments([f"study={name}", "seed=1000"]) if run.seed == 1000]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("table", "compared"),
    [
        ("particles", {"recording.draw"}),
        ("distance", {"recording.draw", "recording.occluded"} | {
            f"sensors.stereo.{key}" for key in ("max_distance_m", "max_observations", "selection")
        }),
        ("association", {"sensors.stereo.identifies", "sensors.stereo.sigma_descriptor"}),
        ("observations", {"sensors.stereo.max_observations"}),
        ("laps", set()),
        ("repeats", {"recording.image_draw", "repeats"}),
    ],
)  # fmt: skip
def test_runs_of_gil2008_differ_in_what_their_table_compares(table, compared):
    runs = of_one_seed(f"gil2008/{table}")
    noises = {False: [], True: []}
    for run in runs:
        noises[run.config["sensors"]["stereo"]["correlated"]].append(run)
    assert differing(runs) <= compared | STEREO
    for part in filter(None, noises.values()):  # within one noise
        assert differing(part) <= compared
        scenes = {Scene.of(run) for run in part}
        beliefs = {(run.config["estimator"]["kr"], run.config["estimator"]["kl"]) for run in part}
        assert len(beliefs) == 1
        if table == "observations":
            assert len(scenes) == 1  # one recording for all


def test_comparisons_of_distance_are_within_a_recording():
    """The draws of 3 m, 10 m and 20 m are the same, and so are their worlds."""
    drawn = {}
    for run in plan_experiments(["study=gil2008/distance", "seed=range(1000,1002)"]):
        if run.estimator_name == "fastslam_paper":
            camera = run.config["sensors"]["stereo"]
            kind = (camera["max_observations"], camera["selection"])
            kind += (run.config["recording"]["occluded"],)
            which = (run.seed, run.config["recording"]["draw"])
            drawn.setdefault((kind, camera["max_distance_m"]), set()).add(which)
    for (kind, dmax), which in drawn.items():
        if dmax in (3, 10):
            assert drawn[kind, 20] == which, kind


def test_the_printed_filter_is_the_papers_and_alone_takes_r_at_the_measured_point():
    own = Experiment.compose(["study=gil2008", "estimator=fastslam_paper"]).config["estimator"]
    printed = ("motion", "multinomial", 1.0, "diagonal", "measured")
    keys = ("proposal", "resampling", "ess_share", "noise_model", "noise_at")
    assert tuple(own[key] for key in keys) == printed
    for table in ("particles", "laps", "distance", "observations", "repeats", "association"):
        for run in of_one_seed(f"gil2008/{table}"):
            if run.estimator_name == "fastslam_paper":
                assert tuple(run.config["estimator"][key] for key in keys) == printed


def test_ekf_slam_is_compared_where_r_is_taken_at_the_same_point():
    guessed = {}
    for run in of_one_seed("gil2008/association"):
        own, camera = run.config["estimator"], run.config["sensors"]["stereo"]
        if own["association"] == "mahalanobis":
            kind = (camera["correlated"], own["noise_at"])
            guessed.setdefault(kind, set()).add(run.estimator_name)
    assert guessed == {
        (False, "measured"): {"fastslam_paper", "ekf_slam"},
        (False, "predicted"): {"fastslam", "ekf_slam"},
        (True, "predicted"): {"fastslam", "ekf_slam"},
    }


def test_filters_that_guess_associations_have_the_same_gate():
    for run in of_one_seed("gil2008/association"):
        own = run.config["estimator"]
        if own["association"] != "mahalanobis" or run.config["sensors"]["stereo"]["correlated"]:
            continue
        assert own["d0"] == CHOSEN[run.estimator_name]
        assert not run.config["sensors"]["stereo"]["identifies"]


def test_particle_filters_are_compared_by_the_same_m_and_repeats():
    runs = of_one_seed("gil2008/particles")
    own = {}
    for run in runs:
        if (
            run.config["recording"]["draw"] == 0
            and not run.config["sensors"]["stereo"]["correlated"]
        ):
            own.setdefault(run.estimator_name, []).append(
                (run.config["estimator"]["n_particles"], run.repeats)
            )
    assert own["fastslam"] == own["fastslam_paper"]


def as_judged(study_name, seeds):
    """Drives of decristoforis2020 as its claims' designs run them: drives at the anchor."""
    jobs_of = {
        "methods": partial(decristoforis2020._drives, []),
        "corridor": decristoforis2020._corridors,
    }
    return [group for _, group in jobs_of[study_name](seeds)]


def test_methods_of_decristoforis2020_share_drive_and_beliefs():
    (group,) = as_judged("methods", [1000])
    assert differing(group) == {"method"}
    assert len({run.recording_key for run in group}) == 1
    printed = [run for run in group if run.config["method"] != "fusion_clone"]
    for key in ("kr", "kl", "sigma_range_m", "window_s"):
        assert len({run.config["estimator"].get(key, "") for run in group} - {""}) == 1, key
    for key in ("metric", "covariance", "trim", "kernel", "max_iterations", "stop_error_m"):
        assert len({run.config["estimator"].get(key, "") for run in printed} - {""}) == 1, key
    by_method = {run.config["method"]: dict(flat(run.config["estimator"])) for run in group}
    started, alone = by_method["icp_guess"], by_method["icp"]
    assert {key for key in alone if alone[key] != started[key]} == {"use_odometry_guess"}


def test_the_fusion_of_decristoforis2020_is_the_printed_one():
    (group,) = as_judged("methods", [1000])
    (fusion,) = (run for run in group if run.config["method"] == "fusion")
    own = fusion.config["estimator"]
    assert own["_target_"] == "estimators.laser.ekf_icp_paper.EkfIcpPaper"
    assert (own["metric"], own["covariance"]) == ("point_to_plane", "censi_last")
    assert own["lateral_slip_m"] == 0.0
    assert (
        fusion.config["sensors"]["laser"]["rate_hz"] == 18.75
    )  # as printed: 721 beams take four turns at 75 Hz
    assert fusion.config["sensors"]["laser"]["n_beams"] == 721
    assert fusion.config["route"]["distance_m"] == 100.0


def test_offices_and_corridors_of_decristoforis2020_differ_from_seed_to_seed():
    for study_name, n in (("methods", 40), ("corridor", 20)):
        groups = as_judged(study_name, range(1000, 1000 + n))
        assert [group[0].seed for group in groups] == list(range(1000, 1000 + n))
        assert all(differing(group) <= {"method"} for group in groups)
    worlds = [group[0].world() for group in groups[:3]]
    for place in ("corridor_bare", "curve", "leg_1", "leg_2", "leg_3"):
        assert len({world.places[place].tobytes() for world in worlds}) == 3


def test_metrics_register_the_same_scans(monkeypatch):
    asked = []

    def register(source, target, guess=None, **options):
        asked.append((source, target, guess, options))
        return found(source, target, guess, **options)

    found = pairs.register
    monkeypatch.setattr(pairs, "register", register)
    pairs.metrics_of(1000, "room_small", icp.Rules(neighbours=9))
    first, *others = asked
    for source, target, guess, options in others:
        assert source is first[0]
        assert target is first[1]
        assert guess is first[2]
        assert set(options) == {"metric", "rules"}
        assert options["rules"] == icp.Rules(neighbours=9)


def test_planes_and_points_have_the_same_stages_and_end(monkeypatch):
    asked = []

    def aligned(pair, pose, window, settings, stages):
        pinned = settings.pinned.tolist()
        asked.append((pair.whole_lines, pose.copy(), window, settings[:-1], pinned, stages))
        return found(pair, pose, window, settings, stages)

    found = icp._register
    monkeypatch.setattr(icp, "_register", aligned)
    pair = bench.pair("room", "small", 1000)
    scans = [icp.prepare(ranges, bench.BEARINGS_RAD) for ranges in (pair.source_m, pair.target_m)]
    for metric in ("point_to_plane", "point_to_point"):
        icp.register(*scans, metric=metric)
    planes, points = asked
    np.testing.assert_array_equal(planes[1], points[1])
    assert planes[:1] + planes[2:] == points[:1] + points[2:]


def test_intels_fusion_and_its_rivals_read_the_same_log():
    runs = dict(zip(INTEL, plan_experiments(["study=real_logs/intel"]), strict=True))
    rivals = [runs[name] for name in ("ICP alone", "ICP from the wheels", FUSION)]
    assert differing(rivals) <= {"recording.version", "method"}
    wheels = [runs[name].recording_key for name in ("ICP from the wheels", FUSION)]
    assert len(set(wheels)) == 1


def test_bullet_and_kinematic_robots_drive_the_same_routes_with_the_same_noise():
    runs = of_one_seed("puzzlebot2024/engine")
    assert differing(runs) == {"route.segments", "simulation.physics"}
    by_physics = {}
    for run in runs:
        by_physics.setdefault(run.config["simulation"]["physics"], []).append(run.choices["route"])
    assert by_physics["bullet"] == by_physics["kinematic"]


@pytest.mark.slow
def test_calibrations_see_the_same_runs(monkeypatch):
    arm = puzzlebot2024.arms("calibration")[0]
    seen = []
    calibrate = puzzlebot2024.from_end_poses

    def from_end_poses(manoeuvres, *args, **options):
        seen.append([m.end_poses for m in manoeuvres])
        return calibrate(manoeuvres, *args, **options)

    monkeypatch.setattr(puzzlebot2024, "from_end_poses", from_end_poses)
    found = puzzlebot2024.calibrate_once(arm)
    assert [result.method for result in found] == ["wheel_truth", "sampled", "linearised"]
    for first, second in zip(*seen, strict=True):
        np.testing.assert_array_equal(first, second)
    assert len({result.n_used for result in found[1:]}) == 1


def test_arms_of_one_study_start_at_the_same_pose():
    experiment = Experiment.compose(["study=gil2008", "seed=1000"])
    names = ("fastslam", "fastslam_paper", "ekf_slam", "smoother")
    priors = [
        Experiment.compose(["study=gil2008", "seed=1000", f"estimator={name}"]).config["prior"]
        for name in names
    ]
    assert all(prior == experiment.config["prior"] for prior in priors)
    assert study.labels_of("association", experiment)["filter"] == "fastslam2"


@pytest.fixture
def asked(monkeypatch):
    """What the filter of maximo2024 is run with: its settings, its draws, and its queries."""
    calls = []

    def localize(case, settings, rng, recording=None, keep=()):
        taken = case.recording if recording is None else recording
        calls.append((settings, rng.random(), taken.frame_stamps, taken.truth.poses))
        n = len(taken.frame_stamps)
        return worlds.Walk(np.zeros(n), np.zeros(n), None)

    monkeypatch.setattr(worlds, "localize", localize)
    return calls


def assert_alike(calls, *compared):
    """Runs differ in nothing but these settings; draws are the same."""
    first, *others = calls
    assert others
    for own, draw, stamps, poses in others:
        changed = {key for key in own if own[key] != first[0][key]}
        assert changed <= set(compared)
        assert draw == first[1]
        np.testing.assert_array_equal(stamps, first[2])
        np.testing.assert_array_equal(poses, first[3])
    assert len({json.dumps(call[0]) for call in calls}) == len(calls)


def test_weightings_of_maximo2024_differ_in_nothing_else(asked):
    worlds.weighting_rows(worlds.make_case("umh", 5), 1)
    assert_alike(asked, "weighting")
    assert [settings["weighting"] for settings, *_ in asked] == ["M1", "M2", "M3"]


def test_numbers_of_particles_are_compared_over_the_same_queries(asked):
    case = worlds.make_case("umh", 5)
    list(worlds.particle_rows(case, 1))
    same_draws = [(settings, 0.0, *rest) for settings, _, *rest in asked]  # as many as particles
    assert_alike(same_draws, "particles_per_node")
    assert len({draw for _, draw, *_ in asked}) == len(asked)


def test_kidnappings_with_and_without_injection_are_the_same(asked):
    case = worlds.make_case("umh", 5)
    list(worlds.kidnapping_rows(case, worlds.options(case), 0.05, 3, 30))
    assert len(asked) == 6
    for without, injected in zip(asked[::2], asked[1::2], strict=True):
        assert_alike([without, injected], "injection")


def test_methods_on_a_robot_of_mrclam_read_the_same_log():
    by_robot = {}
    for run in plan_experiments(["study=real_logs/mrclam"]):
        by_robot.setdefault(run.config["recording"]["robot"], []).append(run)
    for runs in by_robot.values():
        rivals = [run for run in runs if run.config["recording"]["calibrated"]]
        assert {run.estimator_name for run in rivals} == {"odometry", "fastslam", "ekf_slam"}
        assert differing(rivals) <= {"recording.identifies"}
