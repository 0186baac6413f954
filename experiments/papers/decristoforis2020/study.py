"""The studies of decristoforis2020: registration, its covariance, and fusion with odometry.

Drives are simulated with the kinematic body, which slips by the same law as the rigid one and takes
half the time; a few with the rigid body and its rays stand beside.
"""

import math
import operator
import timeit
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.cbook import boxplot_stats

from estimators.base import Estimate
from estimators.laser.icp import prepare, register
from estimators.laser.icp_covariance import Scans
from experiments.bench.icp import BEARINGS_RAD, pair
from experiments.evaluation.map_quality import map_points, mean_map_entropy, wall_distances_m
from experiments.evaluation.metrics import (
    heading_errors_rad,
    nees_at_distances,
    position_errors_m,
)
from experiments.evaluation.registration_errors import METRICS, measure, sample_scenes
from experiments.judging.jobs import Progress, Tables, group_by, tables_of
from experiments.judging.logs import DATA
from experiments.judging.remake import Cells, Remake
from experiments.judging.results import Profile, Results
from experiments.papers.decristoforis2020.claims import judged_runs
from experiments.papers.decristoforis2020.settings import (
    CHECKED,
    JUDGED_SEED,
    N_DRIVES,
    N_GEOMETRIES,
    N_REPEATS,
    NEES_AT_M,
    PAIRS,
    PAPERS_OWN,
    PLACES,
    RATE_HZ,
)
from experiments.papers.decristoforis2020.steps import ellipse_path, ellipse_summary, step_errors
from experiments.runs.console import RunFailedError
from experiments.runs.evaluate import evaluate
from experiments.runs.experiment import Experiment
from experiments.runs.row import Outcome, Row
from experiments.runs.seeds import stream
from experiments.sweeps.plan import plan_experiments
from sim.arrays import Array
from sim.recording import Recording
from sim.sensors import Laser, sensor_of
from sim.team import Team

Job = tuple[float, Callable[..., Tables], Sequence[Any]]  # cost, function, arguments

_RUN = {
    "seed": "seed",
    "rate_hz": "sensors.laser.rate_hz",
    "rays": "simulation.rays",
    "method": "method",
}
_BELIEF = {"seed": "seed", "belief": "belief"}
_ADJUSTED = {
    name: f"estimator.{name}" for name in ("acceleration_noise", "turn_noise")
}  # by experiment, as the paper says
_NOISE = {
    "seed": "seed",
    "k_m": "robot.kr",
    "sigma_range_m": "sensors.laser.sigma_range_m",
    "method": "method",
}


def run(profile: Profile, out: Results, on_progress: Progress) -> None:
    """Run all studies of the paper, and write their tables and what its figures draw.

    Parameters
    ----------
    profile
        `quick`: few and short recordings; `full`: those that the claims are judged on.
    """
    costs, functions, arguments = zip(*_jobs(profile is Profile.FULL, out), strict=True)
    calls = [(function, *given) for function, given in zip(functions, arguments, strict=True)]
    whole = tables_of(operator.call, calls, on_progress, costs)
    whole["boxes"] = _boxes(judged_runs(whole.pop("errors")))
    if "log_errors" in whole:
        whole["log_boxes"] = _boxes(whole.pop("log_errors"))
    scores = ["ate_rmse_m", "heading_rmse_rad", "nees_mean"]
    by_noise = whole["process_noise"].groupby(list(_ADJUSTED), as_index=False)
    whole["process_noise"] = by_noise[scores].mean()
    whole["covariances"] = whole["covariances"].sort_values(["metric", "method", "place", "seed"])
    whole["ordering"] = whole["ordering"][[*_NOISE, "ate_rmse_m", "heading_rmse_rad"]]
    out.write_tables(**whole)


def _jobs(full: bool, out: Results) -> list[Job]:
    """Jobs of all studies; a drive of 100 m through an office costs 1."""
    n, n_drives = (N_GEOMETRIES, N_DRIVES) if full else (4, 4)
    drive, slow, drawn = (1.0, 0.2, 2.5) if full else (0.15, 0.1, 0.6)
    short, shorter = ([], []) if full else (["route.distance_m=8.0"], ["sensors.laser.rate_hz=5.0"])
    ten_hz = ["sensors.laser.rate_hz=10.0", *short]
    engine = ["simulation.physics=bullet", "simulation.rays=bullet"]
    noise = [] if full else ["robot.kr=1e-6,1e-4", "sensors.laser.sigma_range_m=0.01"]
    seeds = range(JUDGED_SEED, JUDGED_SEED + n)
    (office,) = _planned("methods", 1, "route.distance_m=300.0", *shorter)
    first, *others = _planned("corridor", n)
    adjusted = group_by(
        plan_experiments(
            ["study=decristoforis2020/tuning", *([] if full else ["seed=60", *short])]
        ),
        lambda run: run.recording_key,
    )
    on_log = list(plan_experiments(["study=decristoforis2020/log"])) if DATA.is_dir() else []
    return [
        (drawn, _drawn_office, [_only(PAPERS_OWN, office), out]),
        *((0.5, _drawn_log, [group, out]) for group in ([on_log] if on_log else [])),
        *((drive, _drive, [group]) for group in _planned("methods", n_drives, *short)),
        *(
            (slow, _drive, [_only(CHECKED, group)])
            for group in (
                *_planned("methods", 3 if full else 1, *ten_hz),
                *_planned("methods", 2 if full else 1, *ten_hz, *engine),
            )
        ),
        *(
            (slow, _scored, ["beliefs", _BELIEF, group])
            for group in _planned("beliefs", n // 4, *short)
        ),
        *((0.5 * drive, _scored, ["process_noise", _ADJUSTED, group]) for group in adjusted),
        (0.2, _closeup, [first, out]),
        *((0.2, _closeup, [group]) for group in others),
        *(
            (0.1, _scenes, [seed, place, N_REPEATS if full else 6])
            for seed in seeds
            for place in PLACES
        ),
        *(
            (0.005, _metrics, [seed, kind])
            for seed in range(JUDGED_SEED, JUDGED_SEED + 5 * n)
            for kind in PAIRS
        ),
        *(
            (0.2, _scored, ["ordering", _NOISE, _only(CHECKED, group)])
            for group in _planned("ordering", 5 if full else 1, *noise, *short)
        ),
    ]


REMADE = {
    "runs": 25.0,
    "steps": 25.0,
    "covariances": 3.0,
    "ellipses": 3.5,
    "beliefs": 10.0,
    "ordering": 2.0,
    "metrics": 0.1,
}  # not pooled errors, and what only figures show


def remake(table: str, row: Cells) -> Remake:
    """The call that makes a row again."""
    seed = f"{row.get('seed', 0):.0f}"
    if table == "covariances":
        return _scenes, (int(seed), row["place"], N_REPEATS)
    if table == "metrics":
        return _metrics, (int(seed), row["class"])
    study, label, function, named = _RUN_BY[table]
    given = [f"seed={seed}", *(f"{key}={row[name]:g}" for name, key in named.items())]
    if row.get("rays") == "bullet":
        given += ["simulation.physics=bullet", "simulation.rays=bullet"]
    runs = plan_experiments([f"study=decristoforis2020/{study}", *given])
    method = row.get(label, "icp")  # whose steps are in the table of steps
    group = [one for one in runs if one.label(label) == method]
    origin = {"beliefs": _BELIEF, "ordering": _NOISE}.get(table)
    return function, (group,) if origin is None else (table, origin, group)


def _planned(study: str, n_seeds: int, *overrides: str) -> list[list[Experiment]]:
    """Experiments of conf/study/decristoforis2020/*.yaml, grouped by recording."""
    seeds = f"seed=range({JUDGED_SEED},{JUDGED_SEED + n_seeds})"
    runs = plan_experiments([f"study=decristoforis2020/{study}", seeds, *overrides])
    return group_by(runs, lambda run: run.recording_key)


def _only(methods: Sequence[str], group: Sequence[Experiment]) -> list[Experiment]:
    return [experiment for experiment in group if experiment.label("method") in methods]


def _run(
    experiment: Experiment, recording: Recording, origin: dict[str, str]
) -> tuple[Row, Estimate]:
    """Evaluate one run.

    Returns
    -------
    row
        Origin under short names, status, scores; also the NEES at fixed distances, the RMSE that
        the belief expects, and the real-time factor.
    estimate
        The online one.
    """
    seen: list[Estimate] = []
    (found,) = evaluate(
        experiment,
        lambda: Team((recording,)),
        on_estimate=lambda _, __, online, ___: seen.append(online),
    )
    if not seen or found["status"] == Outcome.FAILED:
        raise RunFailedError(f"{experiment.name}: {found['status_code']}: {found['status_detail']}")
    (estimate,) = seen
    truth = recording.truth_at(estimate.stamps)
    squares = nees_at_distances(truth, estimate.means, estimate.covariances, np.array(NEES_AT_M))
    variances = np.mean(np.diagonal(estimate.covariances, axis1=1, axis2=2), axis=0)
    labels = experiment.labels(checksum="")
    return {
        **{name: found[key] for name, key in origin.items()},
        **{key: value for key, value in found.items() if key not in labels},
        **{f"nees_{d:g}m": float(v) for d, v in zip(NEES_AT_M, squares, strict=True)},
        "believed_rmse_m": float(np.sqrt(variances[0] + variances[1])),
        "believed_heading_rmse_rad": float(np.sqrt(variances[2])),
        "realtime_factor": float(np.ptp(estimate.stamps) / estimate.step_seconds.sum()),
    }, estimate


def _drive(group: Sequence[Experiment]) -> Tables:
    """All methods over one recording: scores, maps, steps of registration, errors along it."""
    recording, world = group[0].recording(), group[0].world()
    truth = recording.truth_at(recording.frame_stamps)
    every = round(5.0 * recording.sensor("laser", Laser).rate_hz)
    runs, steps, errors = [], [], []
    for experiment in group:
        row, estimate = _run(experiment, recording, _RUN)
        runs.append(row)
        if row["rate_hz"] == RATE_HZ:
            points = map_points(recording, estimate)
            row["map_distance_m"] = float(wall_distances_m(points, world).mean())
            row["map_entropy"] = mean_map_entropy(points, stream(experiment.seed, "map"))
        origin = {key: row[key] for key in ("seed", "rate_hz", "rays")}
        if row["method"] == "icp":
            steps.append(origin | step_errors(recording, world, estimate))
        off = {
            "method": row["method"],
            "position_m": position_errors_m(truth, estimate.means),
            "heading_rad": np.abs(heading_errors_rad(truth, estimate.means)),
        }
        errors.append(pd.DataFrame(origin | off)[::every])
    return {"runs": pd.DataFrame(runs), "steps": pd.DataFrame(steps), "errors": pd.concat(errors)}


def _scored(table: str, origin: dict[str, str], group: Sequence[Experiment]) -> Tables:
    """Scores of runs over one recording, as rows of a table with their origin."""
    recording = group[0].recording()
    return {table: pd.DataFrame([_run(e, recording, origin)[0] for e in group])}


def _drawn_office(group: Sequence[Experiment], out: Results) -> Tables:
    """One long drive: scores, and ellipses in areas like the paper's A and B.

    Writes what the figures draw: walls, areas, paths at one pose a second, map points.
    """
    recording, world = group[0].recording(), group[0].world()
    stamps = recording.frame_stamps
    keep = np.flatnonzero(np.diff(np.floor(stamps), prepend=-1.0) > 0)
    areas = {"A": world.places["corner"][1], "B": world.places["corridor_objects"][0]}
    arrays = {
        "walls": world.walls,
        "wall_z_m": world.wall_z_m,
        **{f"area_{name}": area for name, area in areas.items()},
        "stamp_s": stamps[keep],
        "truth": recording.truth_at(stamps[keep])[:, :2],
    }
    rows, inside = [], []
    for experiment in group:
        row, estimate = _run(experiment, recording, _RUN)
        rows.append(row)
        points = map_points(recording, estimate)
        arrays[str(row["method"])] = estimate.means[keep, :2]
        arrays[f"{row['method']}_points"] = points.astype(np.float32)
        row["map_distance_m"] = float(wall_distances_m(points, world).mean())
        if row["method"] == "icp":
            path = ellipse_path(recording, world, "point_to_plane", "last")
            inside = [_within(path, area, 2.0).assign(area=name) for name, area in areas.items()]
    out.write_arrays("office", **arrays)
    return {"drawn": pd.DataFrame(rows), "areas": pd.concat(inside)}


def _drawn_log(group: Sequence[Experiment], out: Results) -> Tables:
    """Scores and errors over a real log; writes its paths and map points."""
    recording = group[0].recording()
    arrays: dict[str, Any] = {}
    rows, errors = [], []
    for experiment in group:
        row, estimate = _run(experiment, recording, {"method": "method"})
        method, truth = str(row["method"]), recording.truth_at(estimate.stamps)
        known = np.isfinite(truth).all(axis=1)
        off_m = position_errors_m(truth[known], estimate.means[known])
        off_rad = np.abs(heading_errors_rad(truth[known], estimate.means[known]))
        errors.append(pd.DataFrame({"position_m": off_m, "heading_rad": off_rad, "method": method}))
        rows.append(row)
        points = map_points(recording, estimate, every_s=10.0, every_beam=2)
        arrays |= {method: estimate.means[::5, :2], f"{method}_points": points.astype(np.float32)}
    arrays["truth"] = recording.known_truth.poses[:, :2]
    out.write_arrays("log", **arrays)
    return {"log": pd.DataFrame(rows), "log_errors": pd.concat(errors)}


def _within(path: pd.DataFrame, area: Array, margin_m: float) -> pd.DataFrame:
    """The longest pass of a path through an area and a margin about it, a row every 5 cm."""
    x1, y1, x2, y2 = area
    inside = path["x_m"].between(x1 - margin_m, x2 + margin_m)
    inside &= path["y_m"].between(y1 - margin_m, y2 + margin_m)
    rows = path[inside]
    passes = rows["distance_m"].diff().gt(1.0).cumsum()
    rows = rows[passes == passes.mode().min()]
    return rows.groupby(rows["distance_m"] // 0.05).head(1)


def _closeup(group: Sequence[Experiment], out: Results | None = None) -> Tables:
    """Ellipses of registration from scan to scan along a corridor and through its bends.

    With `out`, also write what the figure draws.
    """
    recording, world = group[0].recording(), group[0].world()
    rows, tables = [], {}
    for experiment in group:
        believed = experiment.options_of("estimator")
        scans: Scans = "last" if believed["covariance"] == "censi_last" else "both"
        path = ellipse_path(recording, world, believed["metric"], scans, believed["neighbours"])
        origin = {"seed": experiment.seed, "method": experiment.label("method")}
        rows.append(origin | ellipse_summary(path))
        if out is not None and origin["method"] == "printed":
            out.write_arrays("corridor", walls=world.walls, wall_z_m=world.wall_z_m)
            tables["ellipse_path"] = path.assign(seed=experiment.seed)
    return {"ellipses": pd.DataFrame(rows), **tables}


def _scenes(seed: int, place: str, n_repeats: int) -> Tables:
    """Many registrations of one pair of poses in a place, and all covariances of them."""
    study, part = PLACES[place]
    experiment = Experiment.compose([f"study=decristoforis2020/{study}", f"seed={seed}"])
    laser = sensor_of(experiment.sensors(), "laser", Laser)
    rng = stream(seed, f"scenes/{place}")
    (scene,) = sample_scenes(experiment.world(), part, laser.mount.pose, rng, 1)
    found = measure(scene, laser, rng, n_repeats, max(2, n_repeats // 4))
    return {"covariances": found.assign(seed=seed, place=place)}


def _metrics(seed: int, kind: str) -> Tables:
    """All metrics on one of the benchmark's pairs: error and time, without an initial guess."""
    place, size = kind.split("_")
    p = pair(place, size, seed)
    target, source = (prepare(r, BEARINGS_RAD) for r in (p.target_m, p.source_m))
    rows = []
    for metric in METRICS:
        match = partial(register, source, target, metric=metric)
        off = match().T_target_source - p.T_target_source
        rows.append(
            {
                "seed": seed,
                "class": kind,
                "metric": metric,
                "error_m": float(np.hypot(off[0], off[1])),
                "error_rad": abs(math.remainder(off[2], 2.0 * math.pi)),
                "time_us": 1e6 * min(timeit.repeat(match, number=1, repeat=3)),
                "bound_m": math.sqrt(p.bound[0, 0] + p.bound[1, 1]),
            }
        )
    return {"metrics": pd.DataFrame(rows)}


def _boxes(errors: pd.DataFrame) -> pd.DataFrame:
    """Quartiles and whiskers (1.5 times the interquartile range) of the pooled errors."""
    by_method = errors.groupby("method")
    rows = [
        {"method": method, "error": name, "n": len(values), **boxplot_stats(values)[0]}
        for method in PAPERS_OWN
        for name, values in by_method.get_group(method)[["position_m", "heading_rad"]].items()
    ]
    kept = ["method", "error", "n", "whislo", "q1", "med", "q3", "whishi", "mean"]
    return pd.DataFrame(rows)[kept]


_AT = {"k_m": "robot.kr", "sigma_range_m": "sensors.laser.sigma_range_m"}
_RUN_BY: dict[str, tuple[str, str, Callable[..., Tables], dict[str, str]]] = {
    "runs": ("methods", "method", _drive, {"rate_hz": _RUN["rate_hz"]}),
    "steps": ("methods", "method", _drive, {"rate_hz": _RUN["rate_hz"]}),
    "ellipses": ("corridor", "method", _closeup, {}),
    "beliefs": ("beliefs", "belief", _scored, {}),
    "ordering": ("ordering", "method", _scored, _AT),
}  # by table: its study, the label of its rows, what makes them, and further keys by column
