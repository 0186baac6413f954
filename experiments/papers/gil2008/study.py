"""The studies of gil2008: particles, distance, observations, association, noise, cost.

Each table is a study of conf/study, whose swept values are its runs. Runs over one scene share its
recording.
"""

import dataclasses
import json
from collections.abc import Iterator, Sequence
from itertools import accumulate

import numpy as np

from estimators.odometry import Odometry
from experiments.bench.fastslam import cost_by_landmarks
from experiments.evaluation.metrics import position_errors_m, rms, travelled_m
from experiments.judging.jobs import Progress, Tables, group_by, tables_of
from experiments.judging.remake import Cells, Remake, agrees
from experiments.judging.results import Profile, Results
from experiments.papers.gil2008 import scores, settings
from experiments.papers.gil2008.recordings import Scene, landmark_distances_m, thin, whole
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

    def drawn_from(run: TableRun) -> tuple[Scene, str]:
        return Scene.of(run[1]), json.dumps(run[1].options_of("route"))

    jobs = [
        [part[low : low + _RUNS_PER_JOB]]
        for part in group_by(plan(profile), drawn_from)
        for low in range(0, len(part), _RUNS_PER_JOB)
    ]
    tables = tables_of(rows_of, jobs, lambda share: on_progress(0.95 * share))
    out.write_tables(**tables, cost=cost_by_landmarks(settings.N_TIMINGS[profile]))
    write_arrays(out)
    on_progress(1.0)


def plan(profile: Profile) -> Iterator[TableRun]:
    """All runs; the quick profile has the same ones over two worlds, with fewer repeats."""
    n_draws, n_repeats = settings.N_DRAWS[profile], settings.N_REPEATS[profile]
    for table in settings.LABELS:
        few = profile is Profile.QUICK and table != "repeats"  # which has one world
        for one in plan_experiments(
            [f"study=gil2008/{table}", *few * [f"seed={settings.QUICK_SEEDS}"]]
        ):
            drawn = one.options_of("recording")
            if drawn["draw"] < n_draws and drawn["image_draw"] <= n_repeats:
                yield table, one.with_values(repeats=min(one.repeats, n_repeats))


REMADE = dict.fromkeys(settings.LABELS, 2.7)  # not the times of `cost`


def remake(table: str, row: Cells) -> Remake | None:
    """The call that makes a row again; None if no run is like it."""
    for one in plan_experiments([f"study=gil2008/{table}", f"seed={row['seed']:.0f}"]):
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
    truth, robot = recording.truth_at(recording.frame_stamps), first.robot()
    prior = first.prior(recording)
    rng = stream(0, "odometry")
    odometry, _ = run_over(recording, Odometry(kr=robot.kr, kl=robot.kl), prior, rng)
    common: Row = {
        **dataclasses.asdict(scene),
        "odometry_rmse_m": rms(position_errors_m(truth, odometry.means)),
        "odometry_revisit_ratio": scores.revisit_ratio(truth, odometry.means),
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
