"""The studies of decristoforis2020: registration, its covariance, and fusion with odometry.

Drives are simulated with the kinematic body, which slips by the same law as the rigid one and takes
half the time; a few with the rigid body and its rays stand beside.
"""

import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import accumulate
from typing import Any, cast

import numpy as np
import pandas as pd
from matplotlib.cbook import boxplot_stats

from estimators.base import Estimate
from estimators.laser.icp import DEFAULT_RULES, Rules
from estimators.laser.icp_covariance import Scans
from experiments.evaluation.map_quality import map_points, mean_map_entropy, wall_distances_m
from experiments.evaluation.metrics import (
    heading_errors_rad,
    nees_at_distances,
    position_errors_m,
)
from experiments.judging.claim import Claim
from experiments.judging.jobs import Progress, Tables, group_by, tables_of
from experiments.judging.logs import DATA
from experiments.judging.region_runs import region_jobs, remake_region
from experiments.judging.remake import Cells, Remake
from experiments.judging.results import FIRST_SEED, Profile, Results
from experiments.judging.sequential import run_worlds
from experiments.papers.decristoforis2020.anchor import anchored, overrides_at
from experiments.papers.decristoforis2020.claims import (
    closed_form_against_hessian,
    dc1,
    dc3,
    dc5,
    dc6,
    judged_runs,
)
from experiments.papers.decristoforis2020.pairs import (
    closed_form_of,
    covariance_levels,
    covariances_of,
    metrics_of,
)
from experiments.papers.decristoforis2020.settings import (
    CHECKED,
    N_GEOMETRIES,
    N_REPEATS,
    NEES_AT_M,
    PAIRS,
    PAPERS_OWN,
    PLACES,
)
from experiments.papers.decristoforis2020.steps import (
    ellipse_path,
    ellipse_summary,
    step_errors,
    stretch_axes,
)
from experiments.runs.console import RunFailedError
from experiments.runs.evaluate import evaluate
from experiments.runs.experiment import Experiment
from experiments.runs.row import Outcome, Row
from experiments.runs.seeds import stream
from experiments.sweeps.plan import plan_experiments
from sim import se2
from sim.arrays import Array
from sim.recording import Recording
from sim.sensors import Laser
from sim.team import Team

Job = tuple[float, Callable[..., Tables], Sequence[Any]]  # cost, function, arguments
Call = tuple[Any, ...]  # function, arguments
JobsOf = Callable[[Sequence[int]], list[Call]]
Judge = Callable[[Mapping[str, pd.DataFrame]], Sequence[Claim]]

_RUN = {
    "seed": "seed",
    "rate_hz": "sensors.laser.rate_hz",
    "rays": "simulation.rays",
    "method": "method",
}
_ENDS = (0.55, 0.9, 0.91, 0.93, 0.95)  # progress after the fixed jobs, and after each design
_BELIEF = {"seed": "seed", "belief": "belief"}
_ADJUSTED = {
    name: f"estimator.{name}" for name in ("acceleration_noise", "turn_noise")
}  # by experiment, as the paper says


def run(profile: Profile, out: Results, on_progress: Progress) -> None:
    """Run all studies of the paper, and write their tables and what its figures draw.

    Parameters
    ----------
    profile
        `quick`: few and short recordings; `full`: those that the claims are judged on.
    """
    fixed, regions = _jobs(profile, out), region_jobs("decristoforis2020", region_run, profile)
    calls = [(function, *given) for _, function, given in fixed] + regions
    costs = [cost for cost, *_ in fixed] + len(regions) * [0.1]
    begun = _ENDS[0]
    whole = tables_of(operator.call, calls, _part_of(on_progress, 0.0, begun), costs)
    for (claims, jobs_of, judge), end in zip(_designed(profile), _ENDS[1:], strict=True):
        block, progress = partial(_block, jobs_of), _part_of(on_progress, begun, end)
        made = run_worlds("decristoforis2020", claims, profile, block, judge, progress)
        begun = end
        for name, table in made.items():
            both = [whole[name], table] if name in whole else [table]
            whole[name] = pd.concat(both, ignore_index=True)
    whole["boxes"] = _boxes(judged_runs(whole.pop("errors")))
    if "log_errors" in whole:
        whole["log_boxes"] = _boxes(whole.pop("log_errors"))
    scores = ["ate_rmse_m", "heading_rmse_rad", "nees_mean"]
    by_noise = whole["process_noise"].groupby(list(_ADJUSTED), as_index=False)
    whole["process_noise"] = by_noise[scores].mean()
    whole["covariances"] = whole["covariances"].sort_values(["metric", "method", "place", "seed"])
    out.write_tables(**whole)
    on_progress(1.0)


def _part_of(on_progress: Progress, begun: float, end: float) -> Progress:
    return lambda share: on_progress(begun + (end - begun) * share)


def _designed(profile: Profile) -> list[tuple[list[str], JobsOf, Judge]]:
    """Claims whose worlds are added until they are decided: their jobs by seeds, and judgement."""
    short = [] if profile is Profile.FULL else ["route.distance_m=8.0"]
    return [
        (["DC1", "DC6"], partial(_drives, short), lambda t: [*dc1(t["runs"]), *dc6(t["runs"])]),
        (["DC3"], _corridors, lambda t: dc3(t["ellipses"])),
        (["DC5"], _pairs, lambda t: list(dc5(t["metrics"]))),
        (["DC4"], partial(_closed_forms, profile), _judge_closed_form),
    ]


def _closed_forms(profile: Profile, seeds: Sequence[int]) -> list[Call]:
    return [(closed_form_of, seed, _n_repeats(profile)) for seed in seeds]


def _judge_closed_form(made: Mapping[str, pd.DataFrame]) -> list[Claim]:
    return list(closed_form_against_hessian(made["closed_form"]))


def _closed_form(profile: Profile, _: Progress) -> Mapping[str, pd.DataFrame]:
    blocks = partial(_block, partial(_closed_forms, profile))
    return run_worlds("decristoforis2020", ["DC4"], profile, blocks, _judge_closed_form)


def _region(name: str, profile: Profile, on_progress: Progress) -> Mapping[str, pd.DataFrame]:
    jobs = region_jobs("decristoforis2020", region_run, profile, name)
    return tables_of(operator.call, jobs, on_progress)


def _wrong_beliefs(profile: Profile) -> list[Call]:
    """Drives of filters that are told another slip or noise than the true one."""
    full, first = profile is Profile.FULL, FIRST_SEED[profile]
    short = [] if full else ["route.distance_m=8.0"]
    seeds = range(first, first + (N_GEOMETRIES if full else 4) // 4)
    return [(_scored, "beliefs", _BELIEF, group) for group in _planned("beliefs", seeds, *short)]


def _beliefs(profile: Profile, on_progress: Progress) -> Mapping[str, pd.DataFrame]:
    return tables_of(operator.call, _wrong_beliefs(profile), on_progress)


PARTS = {"beliefs": _beliefs, "closed_form": _closed_form} | {
    f"region_{name}": partial(_region, name) for name in ("DC1", "DC2", "DC4")
}


def _block(jobs_of: JobsOf, seeds: Sequence[int]) -> dict[str, pd.DataFrame]:
    return tables_of(operator.call, jobs_of(seeds))


def _drives(short: Sequence[str], seeds: Sequence[int]) -> list[Call]:
    return [(_drive, group) for group in _planned("methods", seeds, *anchored("DC1"), *short)]


def _corridors(seeds: Sequence[int]) -> list[Call]:
    return [(_closeup, group) for group in _planned("corridor", seeds)]


def _pairs(seeds: Sequence[int]) -> list[Call]:
    return [(metrics_of, seed, kind, DEFAULT_RULES) for seed in seeds for kind in PAIRS]


def region_run(name: str, values: Mapping[str, Any], seed: int, profile: Profile) -> Row:
    """Levels of a claim's arms at free settings in one world."""
    if name == "DC4":
        return covariance_levels(values, seed, _n_repeats(profile))
    if name == "DC5":
        rules = Rules(neighbours=int(values["estimator.neighbours"]))
        rows = metrics_of(seed, values["pair of scans"], rules)["metrics"]
        kinds = {"point_to_plane": "plane", "point_to_point": "point"}
        return {
            f"{kinds[row['metric']]}_{key}": max(float(cast(float, row[key])), 1e-9)
            for row in rows
            if row["metric"] in kinds
            for key in ("error_m", "error_rad", "time_us")
        }
    if name == "DC2":
        given = ["study=decristoforis2020/corridor", f"seed={seed}", *overrides_at(values)]
        return stretch_axes(Experiment.compose(given), stream(seed, "stretches"))
    if name == "DC3":
        (group,) = _planned("corridor", [seed], *overrides_at(values))
        row = _closeup([one for one in group if one.label("method") == "printed"])["ellipses"]
        return dict(pd.DataFrame(row).iloc[0].drop(["seed", "method"]))
    length_m = 20.0 if profile is Profile.FULL else 8.0
    (group,) = _planned("methods", [seed], *overrides_at(values), f"route.distance_m={length_m}")
    try:
        runs = pd.DataFrame(_drive(_only(PAPERS_OWN, group))["runs"]).set_index("method")
    except RunFailedError:
        return {}  # its levels stay empty
    columns = ("ate_rmse_m", "heading_rmse_rad", "map_distance_m")
    return {f"{m}_{column}": float(runs.loc[m, column]) for m in PAPERS_OWN for column in columns}


def _n_repeats(profile: Profile) -> int:
    return N_REPEATS if profile is Profile.FULL else 12


def _jobs(profile: Profile, out: Results) -> list[Job]:
    """Jobs whose number is fixed; a drive of 100 m through an office costs 1."""
    full, first = profile is Profile.FULL, FIRST_SEED[profile]
    n, slow, drawn = (N_GEOMETRIES, 0.2, 2.5) if full else (4, 0.1, 0.6)
    short, shorter = ([], []) if full else (["route.distance_m=8.0"], ["sensors.laser.rate_hz=5.0"])
    ten_hz = ["sensors.laser.rate_hz=10.0", *short]
    engine = ["simulation.physics=bullet", "simulation.rays=bullet"]
    at = anchored("DC1")
    (office,) = _planned("methods", [first], *at, "route.distance_m=300.0", *shorter)
    (corridor,) = _planned("corridor", [first])
    adjusted = group_by(
        plan_experiments(
            ["study=decristoforis2020/tuning", *([] if full else ["seed=60", *short])]
        ),
        lambda run: run.recording_key,
    )
    on_log = list(plan_experiments(["study=decristoforis2020/log"])) if DATA.is_dir() else []
    few, fewer = range(first, first + (3 if full else 1)), range(first, first + (2 if full else 1))
    return [
        (drawn, _drawn_office, [_only(PAPERS_OWN, office), out]),
        *((0.5, _drawn_log, [group, out]) for group in ([on_log] if on_log else [])),
        *(
            (slow, _drive, [_only(CHECKED, group)])
            for group in (
                *_planned("methods", few, *at, *ten_hz),
                *_planned("methods", fewer, *at, *ten_hz, *engine),
            )
        ),
        *((slow, function, given) for function, *given in _wrong_beliefs(profile)),
        *((0.5 * slow, _scored, ["process_noise", _ADJUSTED, group]) for group in adjusted),
        (0.2, _drawn_corridor, [corridor, out]),
        *(
            (0.1, covariances_of, [seed, place, N_REPEATS if full else 6])
            for seed in range(first, first + n)
            for place in PLACES
        ),
    ]


REMADE = {
    "runs": 25.0,
    "steps": 25.0,
    "covariances": 3.0,
    "closed_form": 8.0,
    "ellipses": 3.5,
    "beliefs": 10.0,
    "metrics": 0.1,
    "region_DC1": 8.0,
    "region_DC4": 8.0,
    **dict.fromkeys(("region_DC2", "region_DC3"), 2.0),
    "region_DC5": 0.1,
}  # not pooled errors, and what only figures show


def remake(table: str, row: Cells) -> Remake:
    """The call that makes a row again."""
    if table.startswith("region_"):
        return remake_region("decristoforis2020", region_run, table, row)
    seed = f"{row.get('seed', 0):.0f}"
    if table == "covariances":
        return covariances_of, (int(seed), row["place"], N_REPEATS)
    if table == "metrics":
        return metrics_of, (int(seed), row["class"], DEFAULT_RULES)
    if table == "closed_form":
        return closed_form_of, (int(seed), N_REPEATS)
    study, label, function, named = _RUN_BY[table]
    given = [f"seed={seed}", *(f"{key}={row[name]:g}" for name, key in named.items())]
    if row.get("rays") == "bullet":
        given += ["simulation.physics=bullet", "simulation.rays=bullet"]
    at = anchored("DC1") if study == "methods" else []
    runs = plan_experiments([f"study=decristoforis2020/{study}", *at, *given])
    method = row.get(label, "icp")  # whose steps are in the table of steps
    group = [one for one in runs if one.label(label) == method]
    return function, (table, _BELIEF, group) if table == "beliefs" else (group,)


def _planned(study: str, seeds: Sequence[int], *overrides: str) -> list[list[Experiment]]:
    """Experiments of conf/study/decristoforis2020/*.yaml, grouped by recording."""
    given = f"seed={','.join(map(str, seeds))}"
    runs = plan_experiments([f"study=decristoforis2020/{study}", given, *overrides])
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
        points = map_points(recording, estimate)
        row["map_distance_m"] = float(wall_distances_m(points, world).mean())
        row["map_entropy"] = mean_map_entropy(points, stream(experiment.seed, "map"))
        if row["method"] == "odometry":
            for name, path in _by_cause(estimate.means, truth).items():
                points = map_points(recording, replace(estimate, means=path))
                row[f"map_by_{name}_m"] = float(wall_distances_m(points, world).mean())
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


def _by_cause(means: Array, truth: Array) -> dict[str, Array]:
    """Paths (T, 3) whose steps have only the rotation, or only the translation, of an estimate."""
    own, true = (se2.between(poses[:-1], poses[1:]) for poses in (means, truth))
    steps = {
        "rotation": np.column_stack([true[:, :2], own[:, 2]]),
        "translation": np.column_stack([own[:, :2], true[:, 2]]),
    }
    return {
        name: np.array(list(accumulate(each, se2.compose, initial=means[0])))
        for name, each in steps.items()
    }


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


def _drawn_corridor(group: Sequence[Experiment], out: Results) -> Tables:
    """What the figure draws of the first corridor: the ellipses along it."""
    (experiment,) = (one for one in group if one.label("method") == "printed")
    world, path = experiment.world(), _ellipses_of(experiment)
    out.write_arrays("corridor", walls=world.walls, wall_z_m=world.wall_z_m)
    return {"ellipse_path": path.assign(seed=experiment.seed)}


def _closeup(group: Sequence[Experiment]) -> Tables:
    """Ellipses of registration from scan to scan along a corridor and through its bends."""
    rows = [
        {"seed": one.seed, "method": one.label("method")} | ellipse_summary(_ellipses_of(one))
        for one in group
    ]
    return {"ellipses": pd.DataFrame(rows)}


def _ellipses_of(experiment: Experiment) -> pd.DataFrame:
    believed = experiment.options_of("estimator")
    scans: Scans = "last" if believed["covariance"] == "censi_last" else "both"
    given = believed["metric"], scans, believed["neighbours"]
    return ellipse_path(experiment.recording(), experiment.world(), *given)


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


_RUN_BY: dict[str, tuple[str, str, Callable[..., Tables], dict[str, str]]] = {
    "runs": ("methods", "method", _drive, {"rate_hz": _RUN["rate_hz"]}),
    "steps": ("methods", "method", _drive, {"rate_hz": _RUN["rate_hz"]}),
    "ellipses": ("corridor", "method", _closeup, {}),
    "beliefs": ("beliefs", "belief", _scored, {}),
}  # by table: its study, the label of its rows, what makes them, and further keys by column
