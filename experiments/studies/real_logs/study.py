"""The estimators on logs that others recorded, next to the errors published with them."""

import dataclasses
import itertools
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from experiments.calibration.logs import (
    axle_at,
    calibrate_track,
    calibrate_wheels,
    dead_reckoning_rms_m,
    slip_of_turns,
)
from experiments.evaluation.metrics import score, travelled_m
from experiments.evaluation.relations import relation_errors
from experiments.evaluation.statistics import block_interval, blocks_of
from experiments.evaluation.time_sync import aligned_ate_m
from experiments.judging.jobs import Progress, Tables, in_parallel
from experiments.judging.logs import (
    CALIBRATED_S,
    DATA,
    GRAPHS,
    known_start,
    relations_of,
    track,
    tuned_until_s,
    why_missing,
)
from experiments.judging.remake import Cells, Remake, whole
from experiments.judging.results import Profile, Results
from experiments.runs.evaluate import run_over
from experiments.runs.experiment import Experiment
from experiments.runs.row import Row
from experiments.studies.real_logs.building import closed_loops
from experiments.studies.real_logs.grid_match import beam_points, best_fit
from experiments.studies.real_logs.settings import (
    DRAWN_ROBOT,
    FASTSLAM_SEEDS,
    FREIBURG,
    FUSION,
    GMAPPING,
    HELD_OUT,
    INTEL,
    INTEL_DRAWN,
    KHEPERA,
    KUEMMERLE,
    LEGO_START_RAD,
    MRCLAM,
    MRCLAM_DRAWN,
    MRCLAM_METHODS,
    MRCLAM_ROBOTS,
    RAWSEEDS,
    TUNED_ROBOTS,
    WEAN_LOGS,
)
from experiments.sweeps.plan import plan_experiments
from sim import se2
from sim.arrays import Array
from sim.formats import carmen, lego, rawseeds, wean
from sim.formats.khepera import read_khepera
from sim.formats.relations import Relations
from sim.formats.text import read_members, read_words, split_words
from sim.sensors import Laser

Paths = dict[str, NDArray[np.float32]]  # (T, 2) m, by name

_SCORES = ("ate_rmse_m", "ate_aligned_rmse_m", "heading_rmse_rad", "nees_mean", "step_time_us")


def run(profile: Profile, out: Results, on_progress: Progress) -> None:
    """Run all studies, and write their tables and the paths that are drawn.

    Parameters
    ----------
    profile
        `quick`: fewer robots, seeds and hypotheses.
    """
    out.write_tables(ate=rawseeds_ate(), wheels=wheels(), lego=lego_errors())
    on_progress(0.1)
    errors, paths = intel_relations()
    printed = [
        {"log": log, "method": f"{name} (printed)", "part": "all"}
        | {"translation_mean_m": mean, "translation_std_m": spread}
        for log, figures in KUEMMERLE.items()
        for name, (mean, spread) in figures.items()
    ]
    out.write_tables(relations=pd.DataFrame([*errors, *freiburg_relations(), *printed]))
    out.write_arrays("intel", **paths)
    found, grids = closed_loops()
    out.write_tables(building=found)
    out.write_arrays("building", **grids)
    on_progress(0.3)
    slam, paths = landmark_slam(profile, lambda share: on_progress(0.3 + 0.5 * share))
    out.write_arrays("mrclam", **paths)
    fits, drawn = wean_fit(WEAN_LOGS[profile])
    out.write_arrays("wean", **drawn)
    out.write_tables(mrclam=slam, wean=fits)
    on_progress(1.0)


REMADE = {"ate": 10.0, "wheels": 10.0, "lego": 10.0, "mrclam": 20.0}  # others take minutes


def remake(table: str, row: Cells) -> Remake | None:
    """The call that makes a row again; None without the logs."""
    makers = {"ate": rawseeds_ate, "wheels": wheels, "lego": lego_errors}
    if why_missing():
        return None
    if table == "mrclam":
        runs = plan_experiments(["study=real_logs/mrclam", f"recording.robot={row['robot']:.0f}"])
        run = dict(zip(MRCLAM, runs, strict=True))[row["method"]]
        job = (run, row["method"], int(row["robot"]), int(row["seed"]))
        return _landmark_rows, job
    return whole, (table, makers[table])


def _landmark_rows(run: Experiment, method: str, robot: int, seed: int) -> Tables:
    return {"mrclam": [_landmark_job(run, method, robot, seed)[0]]}


# --- Rawseeds ------------------------------------------------------------------------------------


def rawseeds_ate() -> pd.DataFrame:
    """Position RMSE of the stored trajectories beside the printed figures."""
    members = read_members(DATA / "rawseeds_bicocca_reference/rawseeds_bicocca_25a_25b.tar.xz")

    def trajectory(session: str, name: str) -> tuple[Array, Array]:
        folder = f"Bicocca_2009-02-{session}"
        names = (f"{folder}/{name}.csv", f"{folder}/{folder}-{name}.csv")
        member = next(n for n in names if n in members)
        found = rawseeds.read_trajectory(split_words(members[member], member))
        return found.stamps, found.poses

    rows = [
        (session, name, aligned_ate_m(*truth, *trajectory(session, name)), ate_m)
        for session, printed_m in RAWSEEDS.items()
        for truth in [trajectory(session, "GROUNDTRUTH")]
        for name, ate_m in printed_m.items()
    ]
    return pd.DataFrame(rows, columns=["session", "trajectory", "ate_m", "printed_m"])


# --- Intel and Freiburg 079 ----------------------------------------------------------------------


def intel_relations() -> tuple[list[Row], Paths]:
    """The relations metric of our estimates and of the references on the Intel log; and paths."""
    truth = relations_of("intel")
    runs = dict(zip(INTEL, plan_experiments(["study=real_logs/intel"]), strict=True))
    by_recording = {run.recording_key: run for run in runs.values()}
    recordings = {key: run.recording() for key, run in by_recording.items()}
    sparse, logged = (recordings[runs[name].recording_key] for name in INTEL[:2])
    until_s = tuned_until_s(logged)
    found: dict[str, tuple[Array, Array]] = {}
    for name, run in runs.items():
        estimate, _ = track(run.estimator(), recordings[run.recording_key])
        found[name] = estimate.stamps, estimate.means
    found[GMAPPING] = sparse.known_truth.stamps, sparse.known_truth.poses
    graph = carmen.read_carmen(GRAPHS["intel"])
    rows = [
        row
        for name, path in found.items()
        for row in _relation_rows("intel", name, truth, *path, until_s=until_s, fused=found[FUSION])
    ]
    rows += _relation_rows(
        "intel", "graph (FLIRT)", truth, graph.scan_stamps, graph.scan_poses, near=True
    )
    return rows, {name: _path(found[name][1]) for name in (*INTEL_DRAWN, GMAPPING)}


def freiburg_relations() -> Iterator[Row]:
    """The relations metric of our estimates and of the graph on the log of Freiburg 079."""
    truth = relations_of("fr079")
    for name, run in zip(FREIBURG, plan_experiments(["study=real_logs/fr079"]), strict=True):
        found, _ = track(run.estimator(), run.recording())
        yield from _relation_rows("fr079", name, truth, found.stamps, found.means)
    log = carmen.read_carmen(GRAPHS["fr079"])
    for name, near in (("graph (FLIRT)", False), ("graph (FLIRT), exact stamps", True)):
        yield from _relation_rows("fr079", name, truth, log.scan_stamps, log.scan_poses, near=near)


def _relation_rows(
    log: str,
    method: str,
    relations: Relations,
    stamps: Array,
    poses: Array,
    *,
    near: bool = False,
    until_s: float | None = None,
    fused: tuple[Array, Array] | None = None,
) -> Iterator[Row]:
    """Rows of all relations and, for a tuned method, of those after the tuned part.

    With the path of the fused filter, also how much lower its error is over the same relations.
    """
    parts = {"all": relations}
    if until_s is not None:
        late = np.all(relations.stamps > until_s, axis=1)
        parts["judged"] = Relations(relations.stamps[late], relations.motion[late])
    for part, chosen in parts.items():
        found = relation_errors(chosen, stamps, poses, "near" if near else "interpolated")
        begun = chosen.stamps[found.rows, 0]
        bounds = _block_interval("translation", found.translation_m, begun)
        row: Row = {"log": log, "method": method, "part": part, **found.summary(), **bounds}
        if fused is not None:
            ours = relation_errors(chosen, *fused, "interpolated")
            _, i, j = np.intersect1d(ours.rows, found.rows, return_indices=True)
            lower_m = ours.translation_m[i] - found.translation_m[j]
            row["difference_mean_m"] = float(lower_m.mean())
            row["difference_minutes"] = len(np.unique(blocks_of(begun[j])))
            row |= _block_interval("difference", lower_m, begun[j])
        yield row


def _block_interval(name: str, errors: Array, stamps: Array) -> dict[str, float]:
    """95 % bootstrap interval of a mean; relations that begin in the same minute stay together."""
    found = block_interval(errors, stamps)
    return {f"{name}_low_m": found.low, f"{name}_high_m": found.high}


def _path(poses: Array) -> NDArray[np.float32]:
    return poses[:, :2].astype(np.float32)


# --- MRCLAM --------------------------------------------------------------------------------------


def landmark_slam(profile: Profile, on_progress: Progress) -> tuple[pd.DataFrame, Paths]:
    """Errors of dead reckoning, FastSLAM and EKF-SLAM against motion capture; and some paths."""
    study = "study=real_logs/mrclam"
    runs = {
        robot: dict(zip(MRCLAM, plan_experiments([study, f"recording.robot={robot}"]), strict=True))
        for robot in MRCLAM_ROBOTS[profile]
    }
    ekf = int(profile is Profile.FULL)
    seeds = {"dead reckoning": 1, "FastSLAM": FASTSLAM_SEEDS[profile], "EKF-SLAM": ekf}
    jobs = [
        (run, method, robot, seed)
        for kind, n_seeds in seeds.items()
        for robot, by_method in runs.items()
        for method, run in by_method.items()
        if MRCLAM_METHODS[method][0] == kind
        for seed in range(n_seeds)
    ]
    truth = runs[DRAWN_ROBOT][MRCLAM[1]].recording().known_truth
    paths, rows = {"motion capture": _path(truth.poses[::20])}, []
    for row, path in in_parallel(_landmark_job, jobs, on_progress):
        rows.append(row)
        if (row["robot"], row["seed"]) == (DRAWN_ROBOT, 0) and row["method"] in MRCLAM_DRAWN:
            paths[str(row["method"])] = path
    return pd.DataFrame(rows), paths


def _landmark_job(
    run: Experiment, method: str, robot: int, seed: int
) -> tuple[Row, NDArray[np.float32]]:
    log, rng = run.recording(), np.random.default_rng(seed)
    estimate, _ = run_over(log, run.estimator(), known_start(log), rng)
    found = score(log, estimate, after_s=CALIBRATED_S)
    row: Row = {"robot": robot, "method": method, "seed": seed, "judged": robot not in TUNED_ROBOTS}
    row |= {key: found.get(key, math.nan) for key in _SCORES}
    return row, _path(estimate.means[::5])


# --- wheels --------------------------------------------------------------------------------------


def wheels() -> pd.DataFrame:
    """Khepera: geometry beside the published one; kr and kl by the length of the blocks."""
    archive = DATA / "censi_khepera_calib/khepera_l90_lmov.tar.xz"
    rows: list[dict[str, Any]] = []
    for log, published in KHEPERA.items():
        found = calibrate_wheels(read_khepera(archive, f"{log}.tuple"))
        names = ("diameter_right_m", "diameter_left_m", "axle_m")
        parts: list[tuple[Any, str, Row]] = [
            (found, name, {"published": value, "block": 0})
            for name, value in zip(names, published, strict=True)
        ]
        for block in (1, 2, 4, 8, 16):
            slip = slip_of_turns(found, block, np.random.default_rng(0))
            parts += [(slip, name, {"block": block}) for name in ("kr", "kl")]
        rows += [
            {"log": log, "quantity": name, **dataclasses.asdict(getattr(part, name)), **more}
            for part, name, more in parts
        ]
    return pd.DataFrame(rows)


def lego_errors() -> pd.DataFrame:
    """Dead reckoning of the Lego robot with the lecture's constants and with calibrated ones."""
    folder = DATA / "lego_brenner"
    log = lego.parse_motors(read_words(folder / "robot4_motors.txt.gz"))
    stamps, positions = lego.parse_reference(read_words(folder / "robot4_reference.txt.gz"))
    start, half = axle_at(positions[0], LEGO_START_RAD), stamps < stamps.mean()

    def rms_m(track_m: float) -> float:
        return dead_reckoning_rms_m(log, stamps, positions, lego.TICK_M, track_m, start)

    found = calibrate_track(log, stamps, positions, LEGO_START_RAD)
    first = calibrate_track(log, stamps[half], positions[half], LEGO_START_RAD)
    tick_m, track_m = first.tick_m.value, first.track_m.value
    rest = dead_reckoning_rms_m(log, stamps[~half], positions[~half], tick_m, track_m, first.start)
    whole = found.track_m
    rows = [
        ("geometric width", lego.TICK_M, lego.GEOMETRIC_TRACK_M, rms_m(lego.GEOMETRIC_TRACK_M)),
        (
            "lecture's effective width",
            lego.TICK_M,
            lego.EFFECTIVE_TRACK_M,
            rms_m(lego.EFFECTIVE_TRACK_M),
        ),
        ("calibrated", found.tick_m.value, whole.value, found.rms_m, whole.low, whole.high),
        (HELD_OUT, tick_m, track_m, rest),
    ]
    columns = ["case", "tick_m", "track_m", "rms_m", "track_low_m", "track_high_m"]
    return pd.DataFrame(rows, columns=columns)


# --- Wean Hall -----------------------------------------------------------------------------------


def wean_fit(logs: str) -> tuple[pd.DataFrame, dict[str, NDArray[Any]]]:
    """How well the scans fit the map under each reading of it, and what the figure draws.

    Parameters
    ----------
    logs
        Their numbers, as in `1,2`.
    """
    grid = wean.read_grid(DATA / "wean_hall_mcl" / "wean.dat.gz")
    rows = []
    drawn: dict[str, NDArray[Any]] = {}
    studies = plan_experiments(["study=real_logs/wean", f"recording.number={logs}"])
    for number, run in zip(logs.split(","), studies, strict=True):
        recording = run.recording()
        laser, scans = recording.sensor("laser", Laser), recording.log("laser")
        estimate, _ = track(run.estimator(), recording)
        poses = estimate.means[np.searchsorted(estimate.stamps, scans.stamps)]
        travelled = travelled_m(poses)
        chosen = np.searchsorted(travelled, np.arange(0.0, min(travelled[-1], 15.0), 0.5))
        ranges = scans["ranges_m"][chosen][:, ::3].astype(np.float64)
        points = beam_points(ranges, laser.bearings_rad[::3], laser.mount.pose, poses[chosen])
        for one_means, mirrored in itertools.product(("free", "occupied"), (False, True)):
            read = dataclasses.replace(grid, free_is_one=one_means == "free")
            coarse = _halved(read.occupancy.T if mirrored else read.occupancy)
            fit = best_fit(coarse, 2.0 * grid.cell_m, points)
            labels = {"log": int(number), "one_means": one_means, "mirrored": mirrored}
            pose = dict(zip(("x_m", "y_m", "yaw_rad"), fit.pose, strict=True))
            rows.append({**labels, "score": fit.score, **pose})
            if one_means == "free" and not mirrored:
                drawn[f"path_{number}"] = _path(se2.compose(fit.pose, poses))
                drawn[f"ends_{number}"] = _path(se2.transform(fit.pose, points[:, 0]))
    return pd.DataFrame(rows), drawn | _around(grid, np.concatenate(list(drawn.values())))


def _around(grid: wean.Grid, points: Array) -> dict[str, NDArray[Any]]:
    """The square part of a map that holds all points (N, 2): occupancy, and extent (4,) m."""
    half, middle = 1.05 * max(*np.ptp(points, axis=0), 10.0) / 2.0, points.mean(axis=0)
    first = np.maximum((middle - half) / grid.cell_m, 0).astype(int)
    last = np.minimum((middle + half) / grid.cell_m + 1, grid.values.shape).astype(int)
    cells = grid.occupancy[first[0] : last[0], first[1] : last[1]]
    extent_m = np.stack([first, last], axis=1).ravel() * grid.cell_m
    return {"occupancy": cells.astype(np.float16), "extent_m": extent_m}


def _halved(values: Array) -> Array:
    """A grid of cells twice as large: means of their known cells."""
    n_x, n_y = values.shape[0] // 2, values.shape[1] // 2
    cells = values[: 2 * n_x, : 2 * n_y].reshape(n_x, 2, n_y, 2)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.nansum(cells, axis=(1, 3)) / np.isfinite(cells).sum(axis=(1, 3)))
