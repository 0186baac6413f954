"""The studies of decristoforis2020: registration, its covariance, and fusion with odometry."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from matplotlib.cbook import boxplot_stats
from matplotlib.figure import Figure
from numpy.typing import NDArray

from estimators.base import Estimate
from estimators.base import run as run_estimator
from estimators.gaussian import STILL, Gaussian
from experiments.evaluation.map_quality import map_points, mean_map_entropy, wall_distances_m
from experiments.evaluation.metrics import (
    at_distances,
    heading_errors_rad,
    nees,
    position_errors_m,
    score,
)
from experiments.evaluation.registration_errors import measured, scenes
from experiments.evaluation.scan_bound import fisher_bound
from experiments.report.claims import Claim
from experiments.runs.compose import compose
from experiments.runs.experiment import (
    default_cache,
    make_estimator,
    make_prior,
    make_recording,
    make_world,
)
from experiments.runs.row import write_frame
from experiments.runs.seeds import stream
from sim import se2
from sim.recording import Recording
from sim.sensors import Laser
from sim.world import World

Array = NDArray[np.float64]
Tables = dict[str, pd.DataFrame]
Profile = Literal["quick", "full"]

PAPER = "decristoforis2020"
JUDGED_SEED = 1000  # seeds 0-99 are for tuning
METHODS = {  # the paper's three, and their sounder forms
    "odometry": ("estimator=odometry",),
    "icp": (
        "estimator=icp_odometry",
        "estimator.reference=previous",
        "estimator.use_odometry_guess=false",
    ),
    "fusion": ("estimator=ekf_icp_paper",),
    "icp_keyframe": ("estimator=icp_odometry",),
    "fusion_clone": ("estimator=ekf_icp",),
}
PAPERS_OWN = ("odometry", "icp", "fusion")
BELIEFS = {  # factors of kr and kl, and of the range noise, that the clone filter believes
    "right": (1.0, 1.0),
    "kr, kl / 10": (0.1, 1.0),
    "kr, kl x 10": (10.0, 1.0),
    "sigma / 10": (1.0, 0.1),
    "sigma x 10": (1.0, 10.0),
}
NEES_AT_M = (5.0, 20.0, 50.0, 100.0, 200.0, 290.0)
ORDER_KS = (1e-7, 1e-6, 1e-5, 1e-4, 1e-3)
ORDER_SIGMAS_M = (0.003, 0.01, 0.03)
PLACES = {
    "corridor": ("corridor", "corridor_bare"),
    "corner": ("corridor", "corner"),
    "curve": ("corridor", "curve"),
    "room": ("office", "room"),
}
_WINDOWS_S = (1.0, 10.0)
_HELD_M = 0.02


def run(profile: Profile, out: Path, on_progress: Callable[[float], None]) -> Tables:
    """Run all studies of the paper and write their tables to `out`.

    Parameters
    ----------
    profile
        `quick`: few and short recordings; `full`: what the claims are judged by.
    out
        Folder of the tables.
    on_progress
        Called with the share done.
    """
    full = profile == "full"
    n, length_m = (20, 300.0) if full else (4, 40.0)
    seeds = range(JUDGED_SEED, JUDGED_SEED + n)
    jobs: list[tuple[Any, ...]] = [
        (_office, seed, length_m, 10.0, "exact", tuple(METHODS), True, seed == JUDGED_SEED)
        for seed in seeds
    ]
    slow = seeds[: 5 if full else 1]
    part_m = length_m if full else 10.0
    methods = ("odometry", "icp", "fusion", "fusion_clone")
    jobs += [(_office, seed, part_m, 75.0, "exact", methods, False, False) for seed in slow]
    checked = seeds[: 3 if full else 1]
    jobs += [(_office, seed, part_m, 10.0, "bullet", methods, False, False) for seed in checked]
    jobs += [(_closeup, seed, seed == JUDGED_SEED) for seed in seeds]
    jobs += [(_scenes, seed, place, 60 if full else 10) for seed in seeds for place in PLACES]
    jobs += [
        (_metrics, seed, kind)
        for seed in range(JUDGED_SEED, JUDGED_SEED + 5 * n)
        for kind in ("room_small", "room_large", "corridor_small", "corridor_large")
    ]
    jobs += [
        (_ordering, seed, k, sigma)
        for seed in (seeds[:4] if full else seeds[:1])
        for k in (ORDER_KS if full else ORDER_KS[1::2])
        for sigma in (ORDER_SIGMAS_M if full else ORDER_SIGMAS_M[1:2])
    ]
    parts: dict[str, list[pd.DataFrame]] = {}
    costs, done = [_cost(*job) for job in jobs], 0.0
    for cost, found in zip(costs, _in_parallel(jobs), strict=True):
        for name, frame in found.items():
            parts.setdefault(name, []).append(frame)
        done += cost
        on_progress(done / sum(costs))
    tables = {name: pd.concat(frames, ignore_index=True) for name, frames in parts.items()}
    tables["boxes"] = _boxes(tables.pop("errors"))
    tables["covariances"] = tables["covariances"].sort_values(
        ["metric", "method", "place", "seed"], ignore_index=True
    )
    for name, frame in tables.items():
        write_frame(frame, out / f"{PAPER}_{name}.csv")
    return tables


def _cost(work: Callable[..., Tables], *arguments: Any) -> float:
    """Roughly a job's computing time, of that of a 300 m drive through an office."""
    if work is _office:
        return float(arguments[1]) / 300.0
    return {_closeup: 0.05, _scenes: 0.025, _metrics: 0.004, _ordering: 0.025}[work]


def _in_parallel(jobs: Sequence[tuple[Any, ...]]) -> Any:
    """Call each job's function with its arguments on all cores; results come in the jobs' order."""
    from joblib import Parallel, delayed

    return Parallel(n_jobs=-1, return_as="generator")(delayed(f)(*rest) for f, *rest in jobs)


def office_overrides(seed: int, length_m: float, rate_hz: float, rays: str) -> list[str]:
    """Overrides of one recording in an office."""
    return [
        f"study={PAPER}_office",
        f"seed={seed}",
        f"route.distance_m={length_m}",
        f"sensors.laser.rate_hz={rate_hz}",
        f"simulation.rays={rays}",
    ]


def estimate_by(overrides: Sequence[str], recording: Recording, name: str, seed: int) -> Estimate:
    """Estimate of one estimator over a recording, with its own stream."""
    config = compose(overrides)
    return run_estimator(
        make_estimator(config),
        recording,
        make_prior(config, recording),
        stream(seed, f"estimator/{name}"),
        keep=("registration_covariance",),
    )


def _office(
    seed: int,
    length_m: float,
    rate_hz: float,
    rays: str,
    methods: Sequence[str],
    beliefs: bool,
    show: bool,
) -> Tables:
    """All methods over one recording: scores, maps, steps of registration, wrong beliefs."""
    overrides = office_overrides(seed, length_m, rate_hz, rays)
    recording = make_recording(compose(overrides), default_cache())
    world = make_world(compose(overrides))
    truth = recording.truth_at(recording.frame_stamps)
    labels = {"seed": seed, "rate_hz": rate_hz, "rays": rays}
    runs, errors, paths, maps = [], [], [_path(recording.frame_stamps, truth, "truth")], []
    tables: Tables = {}
    for name in methods:
        estimate = estimate_by([*overrides, *METHODS[name]], recording, name, seed)
        row = labels | {"method": name} | _scores(recording, truth, estimate)
        if rate_hz == 10.0:
            points = map_points(recording, estimate)
            row["map_distance_m"] = float(wall_distances_m(points, world).mean())
            row["map_entropy"] = mean_map_entropy(points, stream(seed, "map"))
        runs.append(row)
        if name == "icp":
            tables["steps"] = _steps(recording, world, truth, estimate, labels)
        if name in PAPERS_OWN and rate_hz == 10.0 and rays == "exact":
            every = slice(None, None, 50)
            off_m = position_errors_m(truth, estimate.means)[every]
            off_rad = np.abs(heading_errors_rad(truth, estimate.means))[every]
            errors.append(
                pd.DataFrame({"method": name, "position_m": off_m, "heading_rad": off_rad})
            )
        if show and name in PAPERS_OWN:
            paths.append(_path(estimate.stamps, estimate.means, name))
            some = points[:: max(1, len(points) // 5000)].round(2)
            maps.append(pd.DataFrame({"method": name, "x_m": some[:, 0], "y_m": some[:, 1]}))
    tables["runs"] = pd.DataFrame(runs)
    if errors:
        tables["errors"] = pd.concat(errors)
    if show:
        tables["paths"], tables["maps"] = pd.concat(paths), pd.concat(maps)
    if beliefs:
        tables["beliefs"] = _wrong_beliefs(overrides, recording, truth, seed)
    return tables


def _scores(recording: Recording, truth: Array, estimate: Estimate) -> dict[str, Any]:
    """Metrics of a run, with the NEES at fixed distances and what the belief says of the error."""
    row: dict[str, Any] = {"status": estimate.status, **score(recording, estimate)}
    squares = nees(truth, estimate.means, estimate.covariances)
    rows = at_distances(truth, np.array(NEES_AT_M))
    for distance, at in zip(NEES_AT_M, rows, strict=True):
        row[f"nees_{distance:g}m"] = float(squares[at]) if at >= 0 else math.nan
    variances = np.trace(estimate.covariances[:, :2, :2], axis1=1, axis2=2)
    row["believed_rmse_m"] = float(np.sqrt(np.mean(variances)))
    row["believed_heading_rmse_rad"] = float(np.sqrt(np.mean(estimate.covariances[:, 2, 2])))
    row["realtime_factor"] = float(np.ptp(estimate.stamps) / estimate.step_seconds.sum())
    return row


def _wrong_beliefs(
    overrides: list[str], recording: Recording, truth: Array, seed: int
) -> pd.DataFrame:
    """Error and NEES of the clone filter that believes wrong kr, kl and range noise."""
    right = compose([*overrides, "estimator=ekf_icp"])
    sigma = right["sensors"]["laser"]["sigma_range_m"]
    rows = []
    for belief, (of_k, of_sigma) in BELIEFS.items():
        believed = [
            "estimator=ekf_icp",
            f"estimator.kr={of_k * right['robot']['kr']}",
            f"estimator.kl={of_k * right['robot']['kl']}",
            f"estimator.sigma_range_m={of_sigma * sigma}",
        ]
        estimate = estimate_by([*overrides, *believed], recording, "ekf_icp", seed)
        rows.append({"seed": seed, "belief": belief, **_scores(recording, truth, estimate)})
    return pd.DataFrame(rows)


def _path(stamps: Array, means: Array, method: str) -> pd.DataFrame:
    """One pose a second."""
    keep = np.flatnonzero(np.diff(np.floor(stamps), prepend=-1.0) > 0)
    x, y, heading = means[keep].T.round(4)
    return pd.DataFrame(
        {"method": method, "stamp_s": stamps[keep], "x_m": x, "y_m": y, "heading_rad": heading}
    )


def _steps(
    recording: Recording, world: World, truth: Array, estimate: Estimate, labels: dict[str, Any]
) -> pd.DataFrame:
    """Errors of registration from scan to scan: correlation, accumulation, and their bound.

    Errors are in the axes of the reference and whitened by the registration's own covariance.
    """
    laser = recording.sensors.laser
    assert laser is not None
    found = [C is not None for C in estimate.extras["registration_covariance"]]
    motions = se2.between(estimate.means[:-1], estimate.means[1:])
    true_motions = se2.between(truth[:-1], truth[1:])
    off = motions - true_motions
    off[:, 2] = se2.wrap(off[:, 2])
    use = np.flatnonzero(found[1:])
    R = np.array([estimate.extras["registration_covariance"][i + 1] for i in use])
    white = np.linalg.solve(np.linalg.cholesky(R), off[use][:, :, None])[:, :, 0]
    sound = np.sum(white**2, axis=1) < 30.0  # a wrong match says nothing of correlations
    sound &= R[:, 0, 0] + R[:, 1, 1] < _HELD_M**2  # nor does a guess where nothing is held
    row: dict[str, Any] = dict(labels)
    for lag in range(1, 6):
        both = sound[lag:] & sound[:-lag] & (use[lag:] - use[:-lag] == lag)
        product = np.sum(white[lag:][both] * white[:-lag][both])
        row[f"correlation_lag_{lag}"] = float(product / np.sum(white[:-lag][both] ** 2))
    row["nees_over_3"] = float(np.mean(np.sum(white[sound] ** 2, axis=1)) / 3.0)
    for window_s in _WINDOWS_S:
        row[f"accumulated_over_predicted_{window_s:g}s"] = _accumulated(
            motions, true_motions, dict(zip(use.tolist(), R, strict=True)), sound, use,
            round(window_s * labels["rate_hz"]),
        )  # fmt: skip
    chosen = use[sound][:: max(1, int(sound.sum()) // 40)]
    bounds = np.array([_step_bound(laser, world, truth[i], truth[i + 1]) for i in chosen])
    sizes = np.hypot(*off[chosen, :2].T)
    row["step_error_m"] = float(np.sqrt(np.mean(sizes**2)))
    row["step_bound_m"] = float(np.sqrt(np.mean(bounds[:, 0, 0] + bounds[:, 1, 1])))
    row["step_error_rad"] = float(np.sqrt(np.mean(off[chosen, 2] ** 2)))
    row["step_bound_rad"] = float(np.sqrt(np.mean(bounds[:, 2, 2])))
    return pd.DataFrame([row])


def _step_bound(laser: Laser, world: World, first: Array, second: Array) -> Array:
    """Least covariance (3, 3) of the laser's motion between two poses of base_link."""
    mount = laser.mount.pose
    return fisher_bound(
        world.walls,
        se2.compose(first, mount),
        se2.compose(second, mount),
        laser.bearings_rad,
        laser.sigma_range_m,
        laser.max_range_m,
    )


def _accumulated(
    motions: Array,
    true_motions: Array,
    covariances: dict[int, Array],
    sound: NDArray[np.bool_],
    use: NDArray[np.int64],
    n: int,
) -> float:
    """NEES over 3 of n steps composed, if each step's error is taken as independent."""
    good = set(use[sound].tolist())
    values = []
    for first in range(0, len(motions) - n + 1, n):
        steps = range(first, first + n)
        if not all(i in good for i in steps):
            continue
        sum_, truth = STILL, np.zeros(3)
        for i in steps:
            sum_ = sum_.then(Gaussian(motions[i], covariances[i]))
            truth = se2.compose(truth, true_motions[i])
        off = sum_.mean - truth
        off[2] = math.remainder(off[2], 2.0 * math.pi)
        values.append(float(off @ np.linalg.solve(sum_.covariance, off)) / 3.0)
    return float(np.mean(values)) if values else math.nan


def _closeup(seed: int, show: bool) -> Tables:
    """Ellipses of registration from scan to scan along a corridor and through a curve."""
    overrides = [f"study={PAPER}_corridor", f"seed={seed}"]
    config = compose(overrides)
    recording = make_recording(config, default_cache())
    truth = recording.truth_at(recording.frame_stamps)
    estimate = estimate_by(overrides, recording, "icp", seed)
    world = make_world(config)
    rolled = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(truth[:, :2], axis=0).T))])
    found = estimate.extras["registration_covariance"]
    use = np.array([i for i, C in enumerate(found) if C is not None])
    cos, sin = np.cos(truth[use - 1, 2]), np.sin(truth[use - 1, 2])
    R = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)
    in_map = R @ np.array([found[i][:2, :2] for i in use]) @ R.transpose(0, 2, 1)
    values, vectors = np.linalg.eigh(in_map)
    path = pd.DataFrame(
        {
            "seed": seed,
            "distance_m": rolled[use],
            "place": world.place_of(truth[use, :2]),
            "x_m": truth[use, 0],
            "y_m": truth[use, 1],
            "heading_rad": truth[use, 2],
            "xx_m2": in_map[:, 0, 0],
            "xy_m2": in_map[:, 0, 1],
            "yy_m2": in_map[:, 1, 1],
            "long_m": np.sqrt(values[:, 1]),
            "short_m": np.sqrt(values[:, 0]),
            "direction_rad": np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]),
        }
    )
    tables = {"ellipses": pd.DataFrame([{"seed": seed, **_ellipse_summary(path)}])}
    if show:
        tables["ellipse_path"] = path
    return tables


def _ellipse_summary(path: pd.DataFrame) -> dict[str, float]:
    """What DC2 and DC3 ask of one run; axes are standard deviations."""
    bare, objects = (path[path["place"] == f"corridor_{name}"] for name in ("bare", "objects"))
    tilt = np.abs(np.remainder(bare["direction_rad"] + math.pi / 2.0, math.pi) - math.pi / 2.0)
    row = {
        "axis_ratio_bare": float((bare["long_m"] / bare["short_m"]).median()),
        "tilt_bare_deg": float(np.degrees(tilt.median())),
        "long_bare_m": float(bare["long_m"].median()),
        "long_objects_m": float(objects["long_m"].median()),
    }
    for bend in ("curve", "corner"):
        inside = path[path["place"] == bend]
        start, end = inside["distance_m"].iloc[0], inside["distance_m"].iloc[-1]
        before = path[path["distance_m"].between(start - 3.0, start - 0.5)]
        after = path[path["distance_m"].between(end + 0.5, end + 3.0)]
        smooth = inside["long_m"].rolling(5, center=True, min_periods=1).median()
        peak = inside.loc[smooth.idxmax()]
        turned = peak["direction_rad"] - before["direction_rad"].iloc[0]
        row |= {
            f"long_before_{bend}_m": float(before["long_m"].median()),
            f"long_in_{bend}_m": float(smooth.max()),
            f"long_median_in_{bend}_m": float(inside["long_m"].median()),
            f"long_after_{bend}_m": float(after["long_m"].median()),
            f"turned_in_{bend}_deg": math.degrees(abs(math.remainder(turned, math.pi))),
        }
    return row


def _scenes(seed: int, place: str, n_repeats: int) -> Tables:
    """Many registrations of one pair of poses in a place, and all covariances of them."""
    world_name, part = PLACES[place]
    config = compose([f"study={PAPER}_{world_name}", f"seed={seed}"])
    world = make_world(config)
    laser = make_laser(config)
    rng = stream(seed, f"scenes/{place}")
    (scene,) = scenes(world, part, laser.mount.pose, rng, 1)
    found = measured(scene, laser, rng, n_repeats, max(2, n_repeats // 4))
    return {"covariances": found.assign(seed=seed, place=place)}


def make_laser(config: dict[str, Any]) -> Laser:
    """Laser of the configuration."""
    from sim.sensors import suite_from_config

    laser = suite_from_config(config["sensors"]).laser
    assert laser is not None
    return laser


def _metrics(seed: int, kind: str) -> Tables:
    """Both metrics over one of the benchmark's pairs: error and time, without a guess."""
    import time

    from estimators.icp import prepare, register
    from experiments.bench.icp import BEARINGS_RAD, pair

    place, size = kind.split("_")
    p = pair(place, size, seed)
    target, source = (prepare(r, BEARINGS_RAD) for r in (p.target_m, p.source_m))
    rows = []
    for metric in ("point_to_line", "point_to_point"):
        taken_s = []
        for _ in range(3):
            begun = time.perf_counter()
            found = register(source, target, metric=metric)
            taken_s.append(time.perf_counter() - begun)
        off = found.T_target_source - p.T_target_source
        rows.append(
            {
                "seed": seed,
                "class": kind,
                "metric": metric,
                "error_m": float(np.hypot(off[0], off[1])),
                "error_rad": abs(math.remainder(off[2], 2.0 * math.pi)),
                "time_us": 1e6 * min(taken_s),
                "bound_m": math.sqrt(p.bound[0, 0] + p.bound[1, 1]),
            }
        )
    return {"metrics": pd.DataFrame(rows)}


def _ordering(seed: int, k: float, sigma_m: float) -> Tables:
    """Return the paper's three methods over 30 m at one slip and one range noise."""
    overrides = [
        *office_overrides(seed, 30.0, 10.0, "exact"),
        "simulation.physics=kinematic",
        f"robot.kr={k}",
        f"robot.kl={k}",
        f"sensors.laser.sigma_range_m={sigma_m}",
    ]
    recording = make_recording(compose(overrides), default_cache())
    rows = []
    for name in (*PAPERS_OWN, "fusion_clone"):
        found = score(recording, estimate_by([*overrides, *METHODS[name]], recording, name, seed))
        rows.append(
            {
                "seed": seed,
                "k_m": k,
                "sigma_range_m": sigma_m,
                "method": name,
                "ate_rmse_m": found["ate_rmse_m"],
                "heading_rmse_rad": found["heading_rmse_rad"],
            }
        )
    return {"ordering": pd.DataFrame(rows)}


def _boxes(errors: pd.DataFrame) -> pd.DataFrame:
    """Quartiles and whiskers (1.5 times the quartiles' distance) of the pooled errors."""
    rows = []
    for method in PAPERS_OWN:
        for name in ("position_m", "heading_rad"):
            values = errors.loc[errors["method"] == method, name].to_numpy()
            (box,) = boxplot_stats(values)
            kept = {key: float(box[key]) for key in ("whislo", "q1", "med", "q3", "whishi", "mean")}
            rows.append({"method": method, "error": name, "n": len(values), **kept})
    return pd.DataFrame(rows)


def claims(tables: Tables, *, quick: bool) -> list[Claim]:
    """Judge DC1-DC6 by the tables."""
    from experiments.papers.decristoforis2020.claims import dc1, dc2, dc3, dc4, dc5, dc6

    judged = [
        *dc1(tables["runs"], tables["ordering"]),
        *dc2(tables["ellipses"]),
        *dc3(tables["ellipses"]),
        *dc4(tables["covariances"]),
        *dc5(tables["metrics"]),
        *dc6(tables["runs"]),
    ]
    command = f"estima reproduce --paper {PAPER}" + ("" if quick else " --full")
    return [claim.completed(study=PAPER, command=command, quick=quick) for claim in judged]


def figures(tables: Tables) -> dict[str, Figure]:
    """Draw all figures of the paper, and those beside them, by file name."""
    from experiments.papers.decristoforis2020 import figures as draw

    office = make_world(compose([f"study={PAPER}_office", f"seed={JUDGED_SEED}"]))
    corridor = make_world(compose([f"study={PAPER}_corridor", f"seed={JUDGED_SEED}"]))
    return {
        f"{PAPER}_1_route": draw.route(office, tables["paths"]),
        f"{PAPER}_2_ellipses": draw.ellipses(corridor, tables["ellipse_path"]),
        f"{PAPER}_3_trajectories": draw.trajectories(office, tables["paths"], tables["runs"]),
        f"{PAPER}_4_errors": draw.boxes(tables["boxes"]),
        f"{PAPER}_5_maps": draw.maps(office, tables["maps"], tables["runs"]),
        f"{PAPER}_runs": draw.runs(tables["runs"]),
        f"{PAPER}_covariances": draw.covariances(tables["covariances"]),
        f"{PAPER}_beliefs": draw.beliefs(tables["beliefs"]),
        f"{PAPER}_ordering": draw.ordering(tables["ordering"]),
        f"{PAPER}_steps": draw.steps(tables["steps"]),
    }
