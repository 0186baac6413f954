"""The studies of gil2008: particles, distance, observations, association, noise, cost.

Each table is a study of conf/study, whose swept values are its runs. Runs over one scene share its
recording.
"""

import dataclasses
import json
import operator
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import accumulate
from typing import Any

import numpy as np
import pandas as pd

from estimators.odometry import Odometry
from experiments.bench.fastslam import cost_by_landmarks
from experiments.evaluation.metrics import heading_errors_rad, position_errors_m, rms, travelled_m
from experiments.judging.claim import Claim
from experiments.judging.jobs import Progress, Tables, group_by, tables_of
from experiments.judging.region_runs import region_jobs, remake_region
from experiments.judging.remake import Cells, Remake, agrees
from experiments.judging.results import FIRST_SEED, Profile, Results
from experiments.judging.sequential import designs, run_worlds
from experiments.papers.gil2008 import scores, settings
from experiments.papers.gil2008.claims import gi3, gi4, gi5, gi7, over_odometry, revisits
from experiments.papers.gil2008.recordings import Scene, drive_of, landmark_distances_m, thin, whole
from experiments.runs.evaluate import run_over, score_run, status_of
from experiments.runs.experiment import Experiment
from experiments.runs.row import Row
from experiments.runs.seeds import stream
from experiments.sweeps.plan import plan_experiments
from experiments.viewing.map import grid_along
from sim import se2
from sim.arrays import Array
from sim.recording import Recording
from sim.robot.arc import arc_increment
from sim.robot.slip import wheel_errors
from sim.sensors import StereoCamera, sensor_of

TableRun = tuple[str, Experiment]  # the table its rows go to; its configuration

_SCORES = (
    "ate_rmse_m",
    "ate_aligned_rmse_m",
    "final_position_error_m",
    "revised_ate_rmse_m",
    "revised_ate_aligned_rmse_m",
    "revised_heading_rmse_rad",
    "n_landmarks",
    "map_rmse_m",
    "map_aligned_rmse_m",
)
_RUNS_PER_JOB = 40


def run(profile: Profile, out: Results, on_progress: Progress) -> None:
    """Run all studies of the paper, and write their tables and the arrays of the figures.

    Parameters
    ----------
    profile
        `quick`: the same runs over fewer worlds, with fewer repeats.
    out
        Where tables and arrays go.
    """
    regions = region_jobs("gil2008", region_run, profile)
    fixed = [run for run in plan(profile) if run[0] not in settings.DESIGNED]
    calls = [*((rows_of, part) for part in _grouped(fixed)), *regions]
    tables = tables_of(operator.call, calls, lambda share: on_progress(0.5 * share))
    for name in settings.DESIGNED:
        tables |= _in_worlds(name, profile)
    on_progress(0.9)
    out.write_tables(**tables, cost=cost_by_landmarks(settings.N_TIMINGS[profile], 2))
    write_arrays(out)
    on_progress(1.0)


def _grouped(runs: Sequence[TableRun]) -> list[Sequence[TableRun]]:
    """Runs over one recording together, in jobs of a like size."""

    def drawn_from(run: TableRun) -> tuple[Scene, str]:
        return Scene.of(run[1]), json.dumps(run[1].options_of("route"))

    return [
        part[low : low + _RUNS_PER_JOB]
        for part in group_by(runs, drawn_from)
        for low in range(0, len(part), _RUNS_PER_JOB)
    ]


def _worlds(name: str, profile: Profile, seeds: Sequence[int]) -> Mapping[str, pd.DataFrame]:
    """A table's rows in more worlds; beyond the first, only of the headlines' runs."""
    runs = list(plan_table(name, profile, seeds))
    if seeds[0] > FIRST_SEED[profile]:
        runs = [run for run in runs if _is_headline(run[1])]
    return tables_of(rows_of, [[part] for part in _grouped(runs)])


def _is_headline(run: Experiment) -> bool:
    """Whether a run has the printed filter, or EKF-SLAM beside it, at the printed noise."""
    camera = sensor_of(run.sensors(), "stereo", StereoCamera)
    printed = run.options_of("estimator").get("noise_at") == "measured"
    return printed and not camera.correlated and not camera.max_observations


def _is_of_gi7(run: Experiment) -> bool:
    """Whether a run is one of GI7's headlines: descriptors and p0 in the middle of their ranges."""
    camera = sensor_of(run.sensors(), "stereo", StereoCamera)
    p0 = run.options_of("estimator").get("p0", settings.P0)
    return (
        _is_headline(run) and camera.sigma_descriptor == settings.DESCRIPTORS and p0 == settings.P0
    )


def _divergence(profile: Profile, _: Progress) -> Mapping[str, pd.DataFrame]:
    return _in_worlds("divergence", profile)


def _in_worlds(name: str, profile: Profile) -> Mapping[str, pd.DataFrame]:
    """A table in worlds that are added until its claims are decided."""
    rows_in, judge = partial(_worlds, name, profile), partial(_judged, name)
    return run_worlds("gil2008", settings.DESIGNED[name], profile, rows_in, judge)


PARTS = {"divergence": _divergence}


def _judged(name: str, made: Mapping[str, pd.DataFrame]) -> list[Claim]:
    """The claims that say whether a table needs more worlds."""
    given = designs("gil2008")
    if name == "divergence":
        return list(gi7(made[name]))
    if name == "distance":
        return [*gi4(made[name]), *gi5(made[name])]
    if name == "laps":
        return list(revisits(made[name], given["GI1"]))
    return [*over_odometry(made[name], given["GI1"]), *gi3(made[name], None, given["GI3"])]


def plan(profile: Profile) -> Iterator[TableRun]:
    """All runs in the first worlds; the quick profile has the same ones over two worlds."""
    for table in settings.LABELS:
        yield from plan_table(table, profile)


def plan_table(
    table: str, profile: Profile, seeds: Sequence[int] | None = None
) -> Iterator[TableRun]:
    """Runs of a table; None: in the worlds that its configuration names."""
    n_draws, n_repeats = settings.N_DRAWS[profile], settings.N_REPEATS[profile]
    if seeds is None and profile is Profile.QUICK:
        seeds = range(settings.N_QUICK)
    worlds = [] if seeds is None else seeds[:1] if table == "repeats" else seeds
    given = [f"seed={','.join(map(str, worlds))}"] if worlds else []
    for one in plan_experiments([f"study=gil2008/{settings.SHARED.get(table, table)}", *given]):
        if table == "divergence" and not _is_of_gi7(one):
            continue
        drawn = one.options_of("recording")
        if drawn["draw"] < n_draws and drawn["image_draw"] <= n_repeats:
            yield table, one.with_values(repeats=min(one.repeats, n_repeats))


def reference_run(values: Mapping[str, Any], seed: int) -> Row:
    """Level of odometry, which figure 7 shows, at free settings."""
    one = Experiment.compose(["study=gil2008", f"seed={seed}", *overrides_at(values)])
    return {"odometry_m": _odometry(one, drive_of(one).recording())["odometry_rmse_m"]}


def overrides_at(values: Mapping[str, Any]) -> list[str]:
    """Overrides of the configuration at free settings: both wheels slip alike."""
    given = [f"{name}={value}" for name, value in values.items()]
    return [*given, *(f"robot.kl={v}" for k, v in values.items() if k == "robot.kr")]


def region_run(name: str, values: Mapping[str, Any], seed: int, profile: Profile) -> Row:
    """Levels of the printed filter's arms at free settings in one world."""
    short = [] if profile is Profile.FULL else ["route.distance_m=40.0"]
    given = [f"seed={seed}", *overrides_at(values), *short]
    if name == "GI7":
        return _association_levels(given, seed)
    base = Experiment.compose(["study=gil2008", "estimator=fastslam_paper", *given])
    recording, fewer = whole(base), settings.FEWER[profile]
    row = _odometry(base, recording)
    for n, far_m in settings.REGION_ARMS:
        keys = ("estimator", "n_particles"), ("sensors", "stereo", "max_distance_m")
        one = base.with_leaves(zip(keys, (fewer.get(n, n), float(far_m)), strict=True))
        row |= _levels(one, recording, f"m{n}_{far_m}m", stream(seed, "estimator/region"))
    return row


def _levels(one: Experiment, recording: Recording, label: str, rng: np.random.Generator) -> Row:
    found = one_run(one, thin(recording, one), rng)
    return {
        f"{label}_position_m": found["revised_ate_rmse_m"],
        f"{label}_map_m": found["map_rmse_m"],
    }


def _association_levels(given: Sequence[str], seed: int) -> Row:
    """Errors by known and guessed association, and EKF-SLAM's beside."""
    row: Row = {}
    for label, own in {
        "known": ["fastslam_paper", "association=known"],
        "descriptor": ["fastslam_paper", "association=descriptor", "d0=40.0"],
        "distance": ["fastslam_paper", "association=mahalanobis", "d0=7.81"],
        "ekf": ["ekf_slam", "association=mahalanobis", "noise_at=measured", "d0=7.81"],
    }.items():
        keys = [f"estimator={own[0]}", *(f"estimator.{key}" for key in own[1:])]
        some = [v for v in given if label != "ekf" or not v.startswith("estimator.p0")]
        is_known = f"sensors.stereo.identifies={str(label == 'known').lower()}"
        one = Experiment.compose(["study=gil2008/association", *keys, *some, is_known])
        found = one_run(one, thin(whole(one), one), stream(seed, "estimator/region"))
        row[f"{label}_m"] = found.get("revised_ate_rmse_m", found["ate_rmse_m"])
    return row


REMADE = dict.fromkeys(settings.LABELS, 2.7)  # not the times of `cost`
REMADE |= {"region_GI1": 20.0, "region_GI7": 10.0}


def remake(table: str, row: Cells) -> Remake | None:
    """The call that makes a row again; None if no run is like it."""
    if table.startswith("region_"):
        return remake_region("gil2008", region_run, table, row)
    study = settings.SHARED.get(table, table)
    for one in plan_experiments([f"study=gil2008/{study}", f"seed={row['seed']:.0f}"]):
        camera = sensor_of(one.sensors(), "stereo", StereoCamera)
        shown = {"n_seen": camera.max_observations, "rule": camera.selection}
        labels = dataclasses.asdict(Scene.of(one)) | labels_of(table, one) | shown
        if agrees(row, {**labels, "max_distance_m": camera.max_distance_m}):
            return rows_of, ([(table, one)], int(row["repeat"]))
    return None


def rows_of(runs: Sequence[TableRun], repeat: int | None = None) -> Tables:
    """Rows of every run over one recording, by table; those of one repeat, if one is given."""
    first = runs[0][1]
    scene, recording = Scene.of(first), whole(first)
    common: Row = {
        **dataclasses.asdict(scene),
        **_odometry(first, recording),
        "matching_precision": scores.matching_precision(recording),
    }
    rows: dict[str, list[Row]] = {}
    for table, experiment in runs:
        seen = thin(recording, experiment)
        labels = labels_of(table, experiment)
        shown = common | labels | _shown(seen)
        for number in range(experiment.repeats) if repeat is None else [repeat]:
            index = 100 * scene.draw + scene.image_draw + number
            rng = stream(scene.seed, f"estimator/{table}/{labels}", index)
            row = {**shown, "repeat": number, **one_run(experiment, seen, rng)}
            rows.setdefault(table, []).append(row)
    return rows


def _odometry(experiment: Experiment, recording: Recording) -> Row:
    """Errors of dead reckoning over a recording."""
    truth, robot = recording.truth_at(recording.frame_stamps), experiment.robot()
    prior, rng = experiment.prior(recording), stream(0, "odometry")
    odometry, _ = run_over(recording, Odometry(kr=robot.kr, kl=robot.kl), prior, rng)
    return {
        "odometry_rmse_m": rms(position_errors_m(truth, odometry.means)),
        "odometry_heading_rmse_rad": rms(heading_errors_rad(truth, odometry.means)),
        "odometry_revisit_ratio": scores.revisit_ratio(truth, odometry.means),
    }


def labels_of(table: str, experiment: Experiment) -> Row:
    """Columns that name a run in its table; their text names its stream."""
    choice, chosen = experiment.estimator_name, experiment.options_of("estimator")
    name = {"fastslam_paper": "paper", "smoother": "batch"}.get(choice, choice)
    if choice == "fastslam":
        name = {"motion": "fastslam1", "optimal": "fastslam2"}[chosen["proposal"]]
    labels = {"filter": name, "noise_at": chosen.get("noise_at", "predicted")}
    return labels | {key: chosen.get(key, settings.P0) for key in settings.LABELS[table]}


def _shown(recording: Recording) -> Row:
    """What the images of a recording show."""
    camera, log = recording.sensor("stereo", StereoCamera), recording.log("stereo")
    far = landmark_distances_m(recording) > 10.0
    return {
        "max_distance_m": camera.max_distance_m,
        "n_seen": camera.max_observations,
        "rule": camera.selection,
        "observations_per_image": float(np.mean(np.diff(log.known_splits))),
        "share_beyond_10_m": float(np.mean(far)) if len(far) else 0.0,
    }


def one_run(experiment: Experiment, recording: Recording, rng: np.random.Generator) -> Row:
    """Scores of one run; an estimator without `finish` is scored by its online path."""
    online, revised = run_over(
        recording, experiment.estimator(), experiment.prior(recording), rng, scores.KEEP
    )
    revised = revised or online
    found = score_run(recording, online, revised)
    return {
        **status_of(recording, online).columns(),
        **{key: found[key] for key in _SCORES if key in found},
        "revisit_ratio": scores.revisit_ratio(recording.truth_at(revised.stamps), revised.means),
        "step_mean_us": 1e6 * float(online.step_seconds.mean()),
        **scores.filter_scores(recording, online),
    }


def write_arrays(out: Results) -> None:
    """Write what the figures draw of one recording, and particles along a motion."""
    path = Experiment.compose(["study=gil2008"])
    recording, scanned = path.recording(), Experiment.compose(["study=gil2008/scans"]).recording()
    log, world = recording.log("stereo"), recording.known_world
    along = recording.truth_at(recording.frame_stamps)
    busiest = int(np.argmax(np.diff(log.known_splits)))
    pictured = {
        "walls": world.walls,
        "wall_z_m": world.wall_z_m,
        "truth": along,
        "travelled_m": travelled_m(along),
        **_gridded("truth", scanned, scanned.known_truth.stamps, scanned.known_truth.poses),
    }
    for option in ("odometry", "fastslam_paper", "fastslam", "smoother"):
        one = Experiment.compose(["study=gil2008", f"estimator={option}"])
        rng = stream(one.seed, "example")
        online, revised = run_over(recording, one.estimator(), one.prior(recording), rng)
        found, name = revised or online, str(labels_of("bound", one)["filter"])
        pictured[name] = found.means
        pictured |= _gridded(name, scanned, found.stamps, found.means)
        if found.map:
            in_image = np.isin(found.map["ids"], log.reading(busiest)["ids"])
            pictured |= {
                f"{name}_landmarks": found.map["landmarks"],
                f"{name}_covariances": found.map["landmark_covariances"],
                f"{name}_in_image": in_image.astype(float),
                f"{name}_image_pose": found.means[
                    np.searchsorted(found.stamps, log.stamps[busiest])
                ],
            }
    out.write_arrays(
        "path",
        revisited=scores.on_revisited_ground(along[::4]),
        **{name: values.astype(np.float32) for name, values in pictured.items()},
    )
    line, particles = particles_along_a_motion(stream(path.seed, "figure"))
    out.write_arrays("motion", line=line.astype(np.float32), particles=particles.astype(np.float32))


def _gridded(name: str, scanned: Recording, stamps: Array, poses: Array) -> dict[str, Array]:
    """Occupancy grid of the scans along a path (T, 3), and its origin."""
    grid, _ = grid_along(scanned, stamps, poses, resolution_m=settings.CELL_M)
    return {f"{name}_grid": grid.probability.astype(float), f"{name}_origin": grid.origin}


def particles_along_a_motion(rng: np.random.Generator) -> tuple[Array, Array]:
    """Poses (28 + 1, 3) by odometry, and at every seventh of them 300 particles drawn by slip.

    The noise is ten times the study's.
    """
    steps = np.array([[0.4, 0.4]] * 10 + [[0.48, 0.32]] * 8 + [[0.4, 0.4]] * 10)
    each = np.tile(steps[:, None], (1, 300, 1))
    drawn = arc_increment(each + wheel_errors(each, 5e-4, rng), track_m=0.4)
    line = accumulate(arc_increment(steps, track_m=0.4), se2.compose, initial=np.zeros(3))
    paths = accumulate(drawn, se2.compose, initial=np.zeros((300, 3)))
    return np.array(list(line)), np.array(list(paths))[7::7]
